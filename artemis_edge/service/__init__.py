"""``artemis-edge run``: the service that owns the devices, records, maps and can be talked to."""
