"""The trigger board on CAN: it gives LiDAR and cameras their pulses, and tells the time of each of them."""
