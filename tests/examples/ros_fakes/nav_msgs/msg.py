from dataclasses import dataclass, field

from std_msgs.msg import Header


@dataclass
class Path:
    header: Header = field(default_factory=Header)
    poses: list = field(default_factory=list)
