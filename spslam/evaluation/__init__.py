"""What a run is judged by: trajectories, surfaces, depth and color images."""
