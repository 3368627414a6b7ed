"""The viewer: a run, live or finished, in a browser; and a recording of a run for rerun.

Attach it to a running loop with `spslam.viewer.run_viewer.open_viewer`, show a finished run with
`spslam.viewer.replay.Replay`. A live run's viewer is a process of its own: this package's modules that it runs begin at
`spslam.viewer.process`.
"""
