"""The paper, in the order of its text, and the code of each part.

| paper | code |
|---|---|
| Def. 1, experience (s, o, o', a) | `genidm.experience`: `Experience`; `goal_step` finds o' |
| Def. 2, Eq. 1, inverse dynamics model φ | `idm`: `Architecture.action` |
| Def. 3, Eq. 2, equivalence modulo orientation (e.m.o.) | `pairs`: `Pairs`, views of one action |
| the rotation of every number, for Def. 3 | `genidm.symmetry`: `Layout.rotate` |
| how far Def. 3 holds, measured | `generalize`: `residual`; `genidm.evaluation.invariance` |
| Def. 4, generalized experience 𝒢(E) | `generalize`: `replay`; its physics: `replaying` |
| Def. 4, G = E ∪ 𝒢(E) | `pairs`: `pairs` |
| Def. 5, Eq. 3, latent feature model ψ | `idm`: `Architecture.latent` |
| Eq. 4, φ on latents | `idm`: `Architecture.action` |
| Eq. 5, 6, losses L1 and L2 | `idm`: `loss_latent`, `loss_action` |
| Eq. 7 and Fig. 4, loss L | `idm`: `loss_siamese` |
| Remark 1, Fig. 1, action for a state and a goal | `genidm.controller`: `Controller` |
| Remark 2, unit vector d | `genidm.controller`: `direction`; in samples: `pairs` |
| §5.1, §5.2, the methods | `methods` |
| §5.3, Fig. 7, waypoints | `genidm.evaluation.waypoints` |
| A.1.1, rewards | `genidm.tasks`; costs: each robot's `cost` |
| A.1.2, Table 2, training | `protocol` (the numbers), `fit` (the loop) |
| A.1.3, test | `protocol` (the numbers), `genidm.evaluation`: `scenarios`, `evaluate` |
| Table 1, Figs. 5, 6, 8, 9 | `protocol` (the paper's numbers), `genidm.report` (ours) |
"""
