"""Offline goal-conditioned RL on a record: the baselines GCBC, GCIVL, HIQL and CRL.

The reference for all four is OGBench (Park et al., 2025, arXiv 2410.20092; `impls/agents` of
github.com/seohongpark/ogbench). docs/baselines.md says what differs here, and why.

| part | module |
|---|---|
| the record as a dataset, and its relabelled goals | `data` |
| the networks | `networks` |
| the learners, each with its losses | `gcbc`, `gcivl`, `hiql`, `crl` |
| what several learners share | `learner`, `implicit` (the value of GCIVL and HIQL) |
| the training loop | `train` |
| the controller that it makes | `policy` |
| the rows of the extended table | `methods` |
"""
