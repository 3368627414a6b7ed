"""For tests: tf2_ros is in no package index. Transforms are published one by one on the topic `tf`."""

from geometry_msgs.msg import TransformStamped


class TransformBroadcaster:
    def __init__(self, node):
        self.publisher = node.create_publisher(TransformStamped, "tf", 10)

    def sendTransform(self, transform):  # noqa: N802 (the name of tf2_ros)
        self.publisher.publish(transform)
