"""Image classifiers under attack: objects of twelve classes, drawn over photographs, changed, judged."""
