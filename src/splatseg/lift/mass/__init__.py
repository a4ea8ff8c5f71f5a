"""Label mass: blending weight of each Gaussian per id, summed over views, and labels from it."""
