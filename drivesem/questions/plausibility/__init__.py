"""How common vehicles are by KITTI's labels, before and after an attack."""
