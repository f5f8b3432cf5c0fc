"""What can be: the way of theta back to it, and the constraints one by one."""
