import torch as th

th.set_num_threads(1)  # small networks are slower on two threads, and xdist runs two tests at once
