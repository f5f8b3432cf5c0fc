"""The human study: the page, its key, answers, and how far people agree."""
