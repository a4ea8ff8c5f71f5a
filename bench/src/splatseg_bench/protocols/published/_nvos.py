"""NVOS: IoU and share of right pixels, mean over its eight tasks."""

from splatseg_bench.protocols.published._rows import Table

_SAGA = Table(
    protocol="nvos", measures=("iou", "accuracy"), source="SAGA, Table 1", verified=True
)  # fmt: skip
_SAGA_TASKS = Table(protocol="nvos", measures=("iou",), source="SAGA, Table 4", verified=True)
_SECOND = Table(protocol="nvos", measures=("iou", "accuracy", "boundary_iou"))

_SURVEY_NVOS = "One survey gives 39.4 and 73.6, the row of the graph cut, to NVOS."
_SURVEY_CUT = "One survey gives these figures to NVOS."
_SURVEY_ISRF = "One survey gives 70.1 and 92.0, the row of NVOS, to ISRF."
_SAGO = "One figure is given for SAGO and SAGOnline."

FIGURES = (
    _SAGA.row("Graph-cut 3D", 39.4, 73.6, note=_SURVEY_CUT),
    _SAGA.row("NVOS", 70.1, 92.0, note=_SURVEY_NVOS),
    _SAGA.row("ISRF", 83.8, 96.4, note=_SURVEY_ISRF),
    _SAGA.row("SGISRF", 86.4, 97.6),
    _SAGA.row("SA3D", 90.3, 98.2),
    _SAGA.row("SAGA v1", 90.9, 98.3, note="The mean of Table 4 is 90.93."),
    *(
        _SAGA_TASKS.row("SAGA v1", iou, scene=task)
        for task, iou in (
            ("fern", 80.45),
            ("flower", 95.51),
            ("fortress", 96.39),
            ("horns_center", 94.65),
            ("horns_left", 92.06),
            ("leaves", 90.58),
            ("orchids", 94.47),
            ("trex", 83.29),
        )
    ),
    _SECOND.row("Graph-cut 3D", 39.4, 73.6, note=_SURVEY_CUT),
    _SECOND.row("NVOS", 70.1, 92.0, note=_SURVEY_NVOS),
    _SECOND.row("ISRF", 83.8, 96.4, note=_SURVEY_ISRF),
    _SECOND.row("SA3D", 90.3, 98.2),
    _SECOND.row("SAGD", 90.4, 98.2, note="GaussianCut's table has an IoU of 72.1."),
    _SECOND.row("Gaussian Grouping", 90.6),
    _SECOND.row("SAGA v1", 90.9, 98.3),
    _SECOND.row("SAGA v2", 92.6),
    _SECOND.row("GaussianTrimmer on SAGA", 92.1),
    _SECOND.row("MV-SAM", 92.1),
    _SECOND.row("SAM2 video", 88.7, note="SAM2's tracking of the video alone, beside MV-SAM."),
    _SECOND.row("VCAR", 93.5, 98.6),
    _SECOND.row("gradient-conflict method", 95.6, note="The source gives it no name."),
    _SECOND.row("OmniSeg3D", 91.7, 98.4),
    _SECOND.row("LUDVIG (SAM2)", 91.3, note="The lower of LUDVIG's variants."),
    _SECOND.row("LUDVIG", 92.4, note="The higher of LUDVIG's variants."),
    _SECOND.row("FlashSplat", 91.8, 98.6),
    _SECOND.row("iSegMan", 92.0, 98.4),
    _SECOND.row("COB-GS", 92.1, 98.6, 79.1, note="Boundary IoU as given beside NG-GS's."),
    _SECOND.row("GaussianCut", 92.5, 98.4),
    _SECOND.row("Trace3D", 92.5, 98.6),
    _SECOND.row("NG-GS", 92.6, 99.2, 84.7),
    _SECOND.row("SAGO", 92.7, 98.7, note=_SAGO),
    _SECOND.row("SAGOnline", 92.7, 98.7, note=_SAGO),
    _SECOND.row("ArtisanGS", 94.1, 98.8),
    _SECOND.row("GaussianSelector (1 round)", 85.3, note="Without SAM."),
    _SECOND.row("GaussianSelector (2 rounds)", 89.6, note="Without SAM."),
    _SECOND.row("GaussianSelector (3 rounds)", 92.2, note="Without SAM."),
)
