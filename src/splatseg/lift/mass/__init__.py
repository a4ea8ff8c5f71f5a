"""Label mass: what views say of each Gaussian, and what is decided from it."""
