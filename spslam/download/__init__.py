"""Public data sets from their official addresses: fetched with resume, checked, unpacked where nothing can escape."""

from spslam.download.catalog import SOURCES, Archive, Source, find_source
from spslam.download.datasets import download, is_complete

__all__ = ["SOURCES", "Archive", "Source", "download", "find_source", "is_complete"]
