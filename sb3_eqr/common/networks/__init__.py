"""
Networks: ``layers`` contains layers that PyTorch lacks, ``encoders`` map observations to group elements, and ``q_networks``
map these to Q values.
"""
