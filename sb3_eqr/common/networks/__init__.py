"""
Networks: ``layers`` has what PyTorch does not have, ``trunks`` turn images into features, ``group_encoder`` features into
group elements, ``q_networks`` these into values of actions.
"""
