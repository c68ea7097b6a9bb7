"""Test, measure and use a GPU within a time limit: `python -m experiments.gpu`.

Every part runs in a child process, one at a time, which is stopped when its time is over: a part
that hangs or crashes on an accelerator cannot lose results, because each number is written as
soon as it is measured. docs/gpu.md explains how to run this, with or without a network.

`__main__` is the command and the order of parts, `jobs` the work of a child, `children` starts
and stops it. `cells` runs cells of Table 1 (a method on a robot), `speeds` measures, `results`
writes.
"""
