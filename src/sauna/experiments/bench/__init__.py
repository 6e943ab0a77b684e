"""How fast this machine trains, against its own physics and against other trainers."""
