"""The scene prior: a point encoder and a geometry decoder, trained together on procedurally generated solids."""

from spslam.prior.encoder import Prior, load_prior

__all__ = ["Prior", "load_prior"]
