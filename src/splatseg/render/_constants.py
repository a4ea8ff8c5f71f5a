"""Every constant of the blending model, with its source and what others do differently.

The model is that of *3D Gaussian Splatting* (Kerbl et al. 2023), as its CUDA code of July 2023
draws it, called "Inria" below. "gsplat" is version 1.5.3. The opacity cap, the near plane and
the low-pass are parameters (`RenderOptions`); the rest is fixed.

| what                      | here           | Inria             | gsplat                        |
|---------------------------|----------------|-------------------|-------------------------------|
| opacity cap               | 0.99           | 0.99              | 0.999                         |
| near plane (z is kept)    | z > 0.01       | z > 0.2           | z >= 0.01                     |
| far plane                 | none           | none              | 1e10                          |
| low-pass (square pixels)  | 0.3            | 0.3               | 0.3 (`eps2d`)                 |
| alpha skipped             | < 1/255        | < 1/255           | < 1/255                       |
| pixel stops, not blending | T' <= 1e-4     | T' < 1e-4         | T' <= 1e-4                    |
| x/z, y/z in the Jacobian  | view + 0.3     | 1.3 (symmetric)   | view + 0.3                    |
| extent on screen          | exact ellipse  | square, 3 sigma   | box, min(3.33, exact) sigma   |
| gradient at the cap       | 0              | as if not capped  | 0                             |

In the Jacobian, x/z and y/z are clamped: "view + 0.3" is the view, wherever the principal point
lies, and 0.3 of its half width on either side; "1.3" is 1.3 half widths around the optical axis,
the same where the principal point is the image centre.

T' is the transmittance behind the Gaussian in question. A 3 sigma square (opacity 1) leaves out
alphas up to 0.011; gsplat's 3.33 sigma box is exact to 1/255, because
:math:`e^{-3.33^2 / 2} < 1/255`, up to the opacity 1.
"""

ALPHA_MIN = 1.0 / 255.0
"""Minimum alpha that is blended, one step of an 8-bit image. Kerbl et al. 2023, appendix C. A
Gaussian with a lower opacity is not blended."""

TRANSMITTANCE_MIN = 1e-4
"""A Gaussian that would bring the transmittance to this or less ends the pixel and is not
itself blended. Kerbl et al. 2023, appendix C, there 0.9999 of opacity."""

ALPHA_MAX = 0.99
"""Default opacity cap: keeps 1 - alpha, by which gradients divide, away from 0. Kerbl et al.
2023, appendix C; gsplat has 0.999."""

NEAR = 0.01
"""Default near plane, scene units. gsplat's; Inria's 0.2 cuts away what a hand-held camera sees
in captures of small scale."""

LOW_PASS = 0.3
"""Default variance added to the projected Gaussian, square pixels, so that it covers at least
about one pixel. Inria's; Zwicker et al. 2002 take 1, Mip-Splatting's code 0.1."""

FRUSTUM_MARGIN = 0.3
"""How far outside the view, in half widths, the Jacobian is still taken where the Gaussian is.
Beyond, the linear approximation of the projection explodes. Inria's "1.3"."""

MEDIAN_TRANSMITTANCE = 0.5
"""The median depth is where the transmittance first falls to this or less. 2DGS (Huang et al.
2024) takes the last Gaussian with more than this before it: the same where the transmittance
falls so far, else the farthest Gaussian, where we say there is none."""
