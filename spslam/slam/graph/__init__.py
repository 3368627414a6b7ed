"""The keyframe graph: what makes poses and map globally consistent."""
