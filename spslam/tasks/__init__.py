"""Work that runs in processes of its own, on this machine or on a Ray cluster: one scheduler over two executors."""
