"""A run over a sequence: reading frames, the frame loop, checkpoints, and the results in an output folder.

Import from the modules, for example `from spslam.run.sequence import RunRequest, run_sequence`. This package does not
import torch, so that `reader_launch` can start a process while torch is loaded.
"""
