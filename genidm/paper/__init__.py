"""The paper, in the order of its text: which function or table is which part of it.

| paper | here |
|---|---|
| Def. 1, experience (s, o, o', a) | `genidm.experience`; o' and d of each step: `pairs` |
| Def. 2 and Eq. 1, inverse dynamics model φ | `idm` |
| Def. 3, Eq. 2, equivalence modulo orientation | `generalize` (`rotate`, `residual`) |
| Def. 4, generalized experience 𝒢(E) | `generalize` (what it is), `replaying` (how it is stepped) |
| G = E ∪ 𝒢(E) | `pairs` |
| Def. 5, Eq. 3 and 4, latent feature model ψ, and φ on its latents | `idm` |
| Eq. 5, 6, 7, losses L1, L2, L | `idm` |
| §5.1, the methods that are compared | `methods` |
| A.1.1, rewards | `genidm.tasks`; costs: each robot's `cost` |
| A.1.2, Table 2, training | `protocol` (the numbers), `fit` (the loop) |
| A.1.3, test | `protocol` (the numbers), `genidm.evaluation` |
| §5.3, Fig. 7, waypoints | `genidm.evaluation.waypoints` |
| Table 1, Figs. 5, 6, 8, 9 | `protocol` (the paper's), `genidm.report` (ours) |
"""
