"""For tests where rclpy is not installed: nodes of one process that talk by calling each other."""

_subscribers = {}
_nodes = []


def init():
    pass


def ok():
    return True


def try_shutdown():
    pass


def spin(node):
    raise KeyboardInterrupt


def spin_once(node, timeout_sec=None):
    while node.inbox:
        callback, message = node.inbox.pop(0)
        callback(message)
