"""Generated places, motions and sensors: RGB-D sequences of any length with exact ground truth."""

from spslam.datasets.places.dataset import Capture, PlacesDataset
from spslam.datasets.places.motion import MOTIONS, Motion
from spslam.datasets.places.place import Place
from spslam.datasets.places.registry import PLACES, make_place
from spslam.datasets.places.sensors import SENSORS, Sensor

__all__ = ["MOTIONS", "PLACES", "SENSORS", "Capture", "Motion", "Place", "PlacesDataset", "Sensor", "make_place"]
