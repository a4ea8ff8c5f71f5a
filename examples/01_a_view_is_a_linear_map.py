"""A view is a sparse matrix W: rendering is W @ signal, lifting is W.T @ image.

Two Gaussians, a red one before a green one. The signal can be anything with one row a Gaussian;
here it is one column for each of two labels.
"""

import torch

from splatseg import Camera, Gaussians, back_project
from splatseg.render import render

gaussians = Gaussians(
    means=torch.tensor([[-0.2, 0.0, 2.0], [0.2, 0.0, 3.0]]),
    rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
    scales=torch.full((2, 3), 0.2),
    opacities=torch.tensor([0.9, 0.8]),
    sh=torch.tensor([[[1.0, -1.0, -1.0]], [[-1.0, 1.0, -1.0]]]),
)
camera = Camera(
    width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0, cam_from_world=torch.eye(4)
)

picture = render(gaussians, camera)
print(f"colour of the centre: {[round(value, 3) for value in picture.image[24, 32].tolist()]}")
print(f"depth of the centre:  {picture.depth[24, 32].item():.3f} scene units")

labels = render(gaussians, camera, torch.eye(2))
winner = labels.image.argmax(-1)[24].tolist()
print("label along the middle row:", "".join(str(label) for label in winner[::4]))

# The adjoint: <W f, g> equals <f, W.T g>, whatever f and g are.
image = torch.rand(48, 64, 2, generator=torch.Generator().manual_seed(0))
lifted = back_project(gaussians, camera, image)
left = (labels.image * image).sum().item()
right = (torch.eye(2) * lifted.sums).sum().item()
print(f"<W f, g> = {left:.4f}, <f, W.T g> = {right:.4f}")
