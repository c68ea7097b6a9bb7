"""A worker that answers each row of two numbers by their sum, or as badly as it is told.

A row whose first number is 13 kills it, and one that is 14 makes it hang.
"""

import os
import signal
import sys
import time

import numpy as np

if "stillborn" in sys.argv:
    sys.exit(1)
os.write(1, np.float32(7).tobytes())
while count := os.read(0, 4):
    n = int(np.frombuffer(count, np.int32)[0])
    rows = np.frombuffer(os.read(0, 8 * n), np.float32).reshape(n, 2)
    if 13 in rows[:, 0]:
        os.kill(os.getpid(), signal.SIGSEGV)
    if 14 in rows[:, 0]:
        time.sleep(60)
    os.write(1, rows.sum(1).astype(np.float32).tobytes())
