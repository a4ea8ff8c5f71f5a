"""Features as a method: each Gaussian takes the mean of the features its pixels have."""

from splatseg.core import Features
from splatseg.lift.mass.features import FeatureUpliftOptions, uplift_features
from splatseg.methods._method import Method, MethodInputs


def run(inputs: MethodInputs, options: FeatureUpliftOptions) -> Features:
    """Lift feature maps, see `lift.uplift_features`."""
    return uplift_features(
        inputs.gaussians,
        inputs.views,
        inputs.evidence,
        options=options,
        backend=inputs.backend,
        progress=inputs.progress,
    )


METHOD = Method(
    name="features",
    summary="each Gaussian takes the mean of the features that its pixels show",
    reference="LUDVIG (Marrie et al. 2024), eq. 4",
    evidence=("features",),
    options=FeatureUpliftOptions,
    run=run,
    returns="features",
)
