"""The scene prior: a depth encoder and a geometry decoder, trained together on procedural solids."""

from spslam.prior.encoder import Prior, load_prior

__all__ = ["Prior", "load_prior"]
