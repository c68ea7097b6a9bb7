"""What the paper reports: the numbers that ours stand beside."""

TABLE1: dict[str, dict[str, tuple[float, float]]] = {
    "humanoid": {
        "RS": (3.159, 0.579),
        "RL": (2.777, 0.841),
        "VGCP": (2.160, 0.955),
        "HER_SP": (2.902, 1.138),
        "HER_DE": (2.891, 1.135),
        "GE": (1.936, 0.977),
        "LR": (1.779, 0.986),
    },
    "minitaur": {
        "RS": (1.598, 0.282),
        "RL": (1.403, 0.438),
        "VGCP": (1.358, 0.326),
        "HER_SP": (1.440, 0.237),
        "HER_DE": (1.380, 0.251),
        "GE": (1.212, 0.485),
        "LR": (0.904, 0.482),
    },
    "ant": {
        "RS": (3.166, 0.569),
        "RL": (2.155, 1.054),
        "VGCP": (2.608, 0.607),
        "HER_SP": (2.602, 0.953),
        "HER_DE": (2.475, 0.693),
        "GE": (1.721, 0.978),
        "LR": (1.105, 0.866),
    },
}
"""Table 1: robot → method → (mean, standard deviation) of the closest distance, in metres."""

METHOD = "LR"
"""The paper's own method, which is compared with every other."""
