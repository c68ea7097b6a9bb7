"""Speed of every part, with its ratio to a limit or a reference that the same run measures.

    pip install -e ".[benchmark]"      # for the rows of Stable-Baselines3 and EnvPool
    python -m experiments.benchmark --run runs/ant/LR-0-0123456789

A row and the row that it is compared with are measured alternately, and the ratio is the median
over these rounds: if the speed of a shared machine drifts, both rows change equally. Programs are
compiled and run once before they are timed.

`measuring` measures one number, `comparing` makes rows of numbers. The measured parts are in
`stepping`, `collecting`, `replaying`, `evaluating`, `fitting`, `others` and `starting`; `rows`
lists all rows.
"""

# This file imports nothing: `sb3` runs in processes without jax.
