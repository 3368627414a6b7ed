"""Models of depth sensors, each after published measurements or equations."""

from spslam.datasets.places.sensors.sensor import SENSORS, Sensor

__all__ = ["SENSORS", "Sensor"]
