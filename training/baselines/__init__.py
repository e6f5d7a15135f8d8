"""What a network has to beat: a pair of scans, and detections, in; flow, ego-motion and object motions out.

Every method is called like the network (`Method`), with a pair and detections whose boxes it follows, and gives a
`Prediction`. The paper's four ("+Det.") come twice: as the paper has them, and as strong as they can be made today.
"""

from training.baselines.rigid_world import Method, ego_registration, ego_true, rigid_flow, zero

# beside every evaluation of a network: they need no detections
BASELINES: dict[str, Method] = {"zero": zero, "ego_true": ego_true, "ego_registration": ego_registration}

__all__ = ["BASELINES", "Method", "ego_registration", "ego_true", "rigid_flow", "zero"]
