"""YOLOv3 and its small relatives (Redmon and Farhadi, 2018, arXiv:1804.02767), as Darknet's files describe it."""
