"""Tracking and mapping: the tracker, the mapper, their state, and the system that connects them."""
