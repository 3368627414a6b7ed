"""A run over a sequence: frames fed to the SLAM system, and what is left of it in an output folder.

Import from the modules: this package itself stays free of torch, so that `reader_launch` can start a process before
torch is loaded.
"""
