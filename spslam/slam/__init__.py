"""Tracking and mapping: the tracker, the mapper, what they remember, and the frame loop that joins them."""
