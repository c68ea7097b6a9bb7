"""A GPU tried, measured and used within a time limit: `python -m experiments.gpu`.

Everything runs in child processes, one at a time, which are stopped when their time is over:
nothing that hangs or crashes on an accelerator takes the results with it. Each number is
written as soon as it is known. docs/gpu.md says how to run this, with or without a network.

`__main__` is the command and the order of things, `jobs` what a child does, `children` starts
and stops it. `cells` runs cells of Table 1, `speeds` measures, `results` writes.
"""
