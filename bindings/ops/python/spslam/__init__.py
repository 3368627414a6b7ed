"""spslam.ops alone: the kernels, without the SLAM system, which is the distribution spslam."""

__version__ = "0.1.0"
