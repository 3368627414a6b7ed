"""spslam: dense RGB-D SLAM with scene priors."""

__version__ = "0.1.0"
