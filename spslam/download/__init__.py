"""Downloads public datasets from their official URLs, with resume and checksums, and unpacks them safely."""

from spslam.download.catalog import SOURCES, Archive, Source, find_source
from spslam.download.datasets import download, is_complete

__all__ = ["SOURCES", "Archive", "Source", "download", "find_source", "is_complete"]
