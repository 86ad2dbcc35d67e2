"""Loop closure after a recording: places seen again, a pose graph, poses corrected (extra ``loop``)."""
