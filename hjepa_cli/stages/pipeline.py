"""Each stage of the pipeline lies in a module of its own, imported when it runs."""

from typing import Any

from hjepa_cli.stages.stage import Imported, Stage


def _stage(name: str, help: str, module: str, **more: Any) -> Stage:
    """Return a stage whose functions ``run`` and ``plan`` lie in a module."""
    run, plan = (Imported(f"hjepa_cli.stages.{module}:{call}") for call in ("run", "plan"))
    return Stage(name, help, run, plan, **more)


TUNE_LAW = _stage(
    "tune-law",
    "Search a control law that holds a plant between sparse packets, for models to learn.",
    "tune_law",
    product="law",
)
COLLECT = _stage(
    "collect",
    "Simulate cart-poles under an exploring teacher and store them as a dataset.",
    "collect",
    product="dataset",
)
TRAIN_ENCODER = _stage(
    "train-encoder",
    "Learn an encoder of camera frames by joint-embedding prediction, or train a baseline.",
    "train_encoder",
    inputs=("dataset",),
    product="checkpoint",
    shared=True,
)
TRAIN_HIERARCHY = _stage(
    "train-hierarchy",
    "Train the predictors of the hierarchy, the flat baseline and the semantic actor.",
    "train_hierarchy",
    inputs=("dataset", "encoder"),
    product="checkpoint",
)
TRAIN_REFLEX = _stage(
    "train-reflex",
    "Train rivals of the predictors: what a packet and its age say, without predicting anything.",
    "train_reflex",
    inputs=("dataset", "checkpoint"),
    product="checkpoint",
)
TRAIN_FUSION = _stage(
    "train-fusion",
    "Train what a hierarchy makes of packets that are not quite right, in noise or few bits.",
    "train_fusion",
    inputs=("dataset", "checkpoint"),
    product="checkpoint",
)
EVAL = _stage(
    "eval",
    "Measure prediction error, control score and tolerated losses of each method.",
    "evaluate",
    inputs=("checkpoint", "further", "dataset", "remeasure", "figure"),
)
SCALE = _stage(
    "scale",
    "Count the devices that one radio cell supports, by method and signal-to-noise ratio.",
    "scale",
    inputs=("checkpoint", "further", "dataset", "remeasure", "verify", "tolerance_steps"),
)
SURVIVE = _stage(
    "survive",
    "Measure how long loops go on without expected packets, and what links that takes.",
    "survive",
    inputs=("checkpoint", "further"),
)
REPRODUCE = _stage(
    "reproduce", "Run all stages into one folder and write the report.", "reproduce",
    product="report",
)  # fmt: skip
BENCH_LINK = _stage(
    "bench-link",
    "Drive simulated devices through the wire and in the simulator, and compare.",
    "bench_link",
    inputs=(
        *("model", "devices", "steps", "lockstep", "period_ms", "gap_steps", "delivery", "trace"),
        *("harm", "checkpoint", "backend"),
    ),
)
