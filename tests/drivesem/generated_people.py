"""A generated street with people on the pavement."""

from __future__ import annotations

import numpy as np
import torch

from drivesem.synth.frames import plan_frame, render_frame
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.types import Frame, SceneIR


def derender_generated_people() -> SceneIR:
    """The street with its people cut out by the network."""
    frame = render_frame(plan_frame(7, 0))
    assert frame is not None
    photograph = torch.from_numpy(frame.image.astype(np.float32) / 255).permute(2, 0, 1).contiguous()
    found = Frame("generated", photograph, frame.camera, frame.labels)
    return derender(found, DerenderSettings(fit=False, people=True))
