class ExternalShutdownException(Exception):  # noqa: N818 (the name of rclpy)
    pass
