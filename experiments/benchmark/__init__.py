"""How fast everything is, as ratios to what limits it, all measured in one run.

    pip install -e ".[benchmark]"      # for the rows of Stable-Baselines3 and EnvPool
    python -m experiments.benchmark --run runs/ant/LR-0-0123456789

A row is measured in turns with the row that it is compared with, and its ratio is the
median over the turns: the speed of a shared machine drifts, but that falls on both alike.
Programs are compiled and run once before anything is timed.

`measuring` takes one number, `comparing` makes rows of numbers; what is measured stands in
`stepping`, `collecting`, `replaying`, `evaluating`, `fitting`, `others` and `starting`, by
subject; `rows` lists it all.
"""

# Nothing is imported here: `sb3` runs in processes that must stay free of jax.
