"""The small closed forms of Bayesian fusion: Gaussians, mixtures, decisions, noise that is learnt."""
