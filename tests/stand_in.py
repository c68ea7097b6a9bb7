"""A worker that answers each row of two numbers by their sum, or as badly as it is told.

A row whose first number is 13 kills it, and one that is 14 makes it hang. With a number as its
last argument it dies so many times before it says anything; the times are counted in a file that is
the argument before.
"""

import os
import signal
import sys
import time

import numpy as np

if "stillborn" in sys.argv:
    sys.exit(1)
if sys.argv[-1].isdecimal():
    with open(sys.argv[-2], "a+") as starts:
        starts.write("x")
        starts.seek(0)
        begun = len(starts.read())
    if begun <= int(sys.argv[-1]):
        os.kill(os.getpid(), signal.SIGKILL)
os.write(1, np.float32(7).tobytes())
while count := os.read(0, 4):
    n = int(np.frombuffer(count, np.int32)[0])
    rows = np.frombuffer(os.read(0, 8 * n), np.float32).reshape(n, 2)
    if 13 in rows[:, 0]:
        os.kill(os.getpid(), signal.SIGSEGV)
    if 14 in rows[:, 0]:
        time.sleep(60)
    os.write(1, rows.sum(1).astype(np.float32).tobytes())
