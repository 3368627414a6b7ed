"""Evaluation of runs against ground truth: trajectory, mesh, depth and color images; the HTML report."""
