"""Keys of a scenario file: the skeleton of the person in the scene, and the labelling of its tracks."""

from typing import Literal

from pydantic import Field, model_validator

from mosca.data.files.toml import Positive, Table

ACTION = "range_of_motion"
"""The action of a calibration take."""


class LabelsSpec(Table):
    """``[labels]``: names of the tracks' markers from a surface model, as of 'mosca labels auto --set face'.

    Scored against the truth: label_* in ``reports.metrics``.
    """

    model: str = Field(description="'face', or a surface model's file (.toml)")


class SkeletonSpec(Table):
    """``[skeleton]``: a model of a person is fitted to labelled tracks, then the pose of each frame of the take.

    Scored against the true joints of the scene's actor: joint_* in ``reports.metrics``.
    """

    fit_to: Literal["take", "range_of_motion"] = Field(
        "take",
        description="what the person's model is fitted to: the take itself, or a take before it in which the same "
        "person, before the same cameras and measured with the same rig, makes action 'range_of_motion'",
    )
    calibration_s: Positive = Field(24.0, le=600, description="length of the take that 'range_of_motion' makes [s]")
    labels: Literal["truth", "auto"] = Field(
        "truth",
        description="where the names of the tracks' markers come from; 'truth': each sample has the name of the true "
        "marker that the scoring pairs it with. A diagnostic premise: identities are given, not found; 'auto': from "
        "a template of the marker set, as of 'mosca labels auto', scored as label_f1 and label_switches",
    )

    @model_validator(mode="after")
    def _has_a_take(self) -> "SkeletonSpec":
        if self.fit_to == "take" and "calibration_s" in self.model_fields_set:
            raise ValueError(
                f"calibration_s = {self.calibration_s:g} and fit_to = 'take' given; it belongs to fit_to = "
                "'range_of_motion': change that, or leave calibration_s out"
            )
        return self
