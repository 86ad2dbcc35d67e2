"""The operator's terminal: attaches to the service (or to a demo), shows, asks, and is never waited for."""
