"""
The latent model, in terms of tensors: ``latent_model`` has the paper's equations, ``conv_latent_model`` SPR's transition,
``gradients`` the place where the gradients of TD and auxiliary losses meet.
"""
