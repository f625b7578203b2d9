"""Work in other processes: a child, a pool of children, a Ray cluster. Used by playing and by fitting."""
