"""Work in other processes: a child, pools of workers here and on a Ray cluster, and their executor."""
