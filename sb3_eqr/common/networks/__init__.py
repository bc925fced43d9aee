"""
Networks: ``layers`` contains layers that PyTorch lacks, ``encoders`` map observations to features or group elements, and
``q_networks`` map these to Q values.
"""
