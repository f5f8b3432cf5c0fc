"""YOLOv3 and its small variants (Redmon and Farhadi, 2018, arXiv:1804.02767), as described by Darknet's files."""
