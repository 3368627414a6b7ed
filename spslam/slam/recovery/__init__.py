"""What happens to a frame whose pose is doubtful: how probable an error is, verification, other starts, relocalization."""
