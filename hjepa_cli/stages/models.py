"""``hjepa models list | info | verify``: what a trained model is, and whether it is intact."""

from typing import Any

from hjepa_cli.config.settings import PRESETS, dotted, load_settings
from hjepa_cli.errors import DataError, HjepaError
from hjepa_cli.output.screen import Screen
from hjepa_cli.storage.zoo import CURVES_FILE, ZooModel, list_models, verify_model

Result = dict[str, Any]


def show_list(screen: Screen) -> Result:
    """List the zoo; a damaged model is listed as such, it does not hide the others."""
    models: list[Result] = []
    for name in list_models():
        try:
            models.append(_summary(verify_model(name)))
        except HjepaError as error:
            models.append({"name": name, "error": error.message})
    if not models:
        screen.say("the zoo is empty; train a model: hjepa collect, then hjepa train-encoder")
    else:
        screen.table(
            "Models of the zoo",
            ["name", "kind", "plant", "h/m/l", "MB", "curves", "sha256"],
            [_row(model) for model in models],
        )
    return {"models": models}


def show_info(screen: Screen, name_or_path: str) -> Result:
    """Describe one model: what it is, how it was trained, how healthy it is.

    Raises:
        MissingInputError: no such model.
        DataError: it is damaged.
    """
    model = verify_model(name_or_path)
    metadata = model.metadata
    rows: list[list[object]] = [[key, value] for key, value in dotted(_summary(model)).items()]
    for key in ("stage", "seed", "dataset", "encoder"):
        if key in metadata:
            rows.append([key, metadata[key]])
    for section in ("architecture", "health", "versions"):
        found = metadata.get(section)
        if isinstance(found, dict):
            rows += [[f"{section}.{key}", value] for key, value in dotted(found).items()]
    screen.table(f"Model {model.name}", ["", "value"], rows)
    return {**_summary(model), "metadata": metadata}


def verify(screen: Screen, names: list[str]) -> Result:
    """Check models against their sha256, all of the zoo if none is named.

    Also says whether the measured curves beside a model are those of the present defaults, which
    ``eval`` and ``scale`` would otherwise measure again.

    Raises:
        MissingInputError: no such model.
        DataError: at least one is damaged; the others are still checked and reported.
    """
    damaged = []
    verified = []
    for name in names or list_models():
        try:
            model = verify_model(name)
            missing = missing_curves(model) if model.has_curves else None
        except DataError as error:
            damaged.append(error)
        else:
            verified.append(_summary(model) | {"missing_curves": missing})
            screen.result(f"{name}: intact, sha256 {model.digest}{_told(missing)}")
    for further in damaged[1:]:
        screen.say(further.message)
    if damaged:
        raise damaged[0]
    return {"verified": verified}


def missing_curves(model: ZooModel) -> list[str]:
    """The default methods that ``curves.json`` does not hold under the default protocol.

    Of a baseline, which holds none of them, the method that it was trained for.

    Raises:
        DataError: not a model that can drive, or damaged curves.
    """
    from hjepa_cli.core.evaluation import curves
    from hjepa_cli.core.networks.model import (
        Model,  # torch: seconds that the other commands need not wait
    )
    from hjepa_cli.stages.model_set import Subject

    plant = model.metadata.get("plant")
    settings = load_settings(plant if plant in PRESETS else None)
    held = Model.load(model.path)
    subject = Subject(settings, held, model.path, None)
    wanted = settings.methods if "hjepa" in held.methods else held.methods[:1]
    found = curves.read(model.path.with_name(CURVES_FILE), subject.digest)
    return [name for name in subject.measurable(wanted) if name not in found]


def _told(missing: list[str] | None) -> str:
    if missing is None:
        return ""
    if not missing:
        return "; its curves are those of the default protocol and methods"
    return f"; default curves to be measured again: {', '.join(missing)}"


def _summary(model: ZooModel) -> Result:
    architecture = model.metadata.get("architecture")
    if not isinstance(architecture, dict):
        raise DataError(f"{model.path} does not say what it is: no architecture")
    plans = architecture.get("kind") != "reflex"  # it keeps those of the model that it is beside
    return {
        "name": model.name,
        "path": str(model.path),
        "kind": architecture.get("kind"),
        "plant": model.metadata.get("plant"),
        "strides": {key: architecture.get(key) if plans else None for key in ("h", "m", "l")},
        "size_bytes": model.size_bytes,
        "curves": model.has_curves,
        "sha256": model.digest,
    }


def _row(model: Result) -> list[object]:
    if "error" in model:
        return [model["name"], f"damaged: {model['error']}", "", "", None, "", ""]
    strides = "/".join(str(stride) for stride in model["strides"].values() if stride is not None)
    if model["kind"] == "flat":  # one level: its m and l are not there
        strides = str(model["strides"]["h"])
    megabytes = f"{model['size_bytes'] / 1e6:.1f}"
    curves = "measured" if model["curves"] else "none"
    return [
        model["name"], model["kind"], model["plant"], strides, megabytes, curves,
        model["sha256"][:12],
    ]  # fmt: skip
