"""Labels of one's own: columns, probing problems of three tasks, controls and results."""
