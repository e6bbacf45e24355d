"""Gymnasium's MuJoCo v5 tasks, from the models inside the installed gymnasium package."""

from rlcli.task import TaskSpec


def _spec(config: str, task: str, summary: str) -> TaskSpec:
    return TaskSpec(__name__, summary, config=f"{config}.yaml", task=f"{__name__}.{task}")


ANT = _spec("ant", "walkers:Ant", "Gymnasium's Ant-v5: run with a four-legged walker.")
HALF_CHEETAH = _spec("half_cheetah", "walkers:HalfCheetah", "Gymnasium's HalfCheetah-v5: run in a plane.")
HOPPER = _spec("hopper", "walkers:Hopper", "Gymnasium's Hopper-v5: hop on one leg in a plane.")
HUMANOID = _spec("humanoid", "humanoids:Humanoid", "Gymnasium's Humanoid-v5: walk.")
HUMANOID_STANDUP = _spec("humanoid_standup", "humanoids:HumanoidStandup", "Gymnasium's HumanoidStandup-v5: get up.")
INVERTED_DOUBLE_PENDULUM = _spec(
    "inverted_double_pendulum",
    "pendulums:InvertedDoublePendulum",
    "Gymnasium's InvertedDoublePendulum-v5: balance two poles on a cart.",
)
INVERTED_PENDULUM = _spec(
    "inverted_pendulum", "pendulums:InvertedPendulum", "Gymnasium's InvertedPendulum-v5: balance a pole on a cart."
)
PUSHER = _spec("pusher", "arms:Pusher", "Gymnasium's Pusher-v5: push a puck to a goal.")
REACHER = _spec("reacher", "arms:Reacher", "Gymnasium's Reacher-v5: reach a point with two links.")
SWIMMER = _spec("swimmer", "walkers:Swimmer", "Gymnasium's Swimmer-v5: swim with three links.")
WALKER2D = _spec("walker2d", "walkers:Walker2d", "Gymnasium's Walker2d-v5: walk on two legs in a plane.")
