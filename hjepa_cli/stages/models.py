"""``hjepa models list | info | verify`` tells what a trained model is, and if it is intact."""

from typing import Any

from hjepa_cli.config.schema import dotted
from hjepa_cli.config.settings import PRESETS, load_settings
from hjepa_cli.errors import DataError, HjepaError, together
from hjepa_cli.output.screen import Screen
from hjepa_cli.storage.zoo import CURVES_FILE, ZooModel, list_models, verify_model

Result = dict[str, Any]

ALL_MEASURED = "its curves are those of the default protocol and methods"
SECTIONS = ("architecture", "health", "versions")  # of a model's metadata


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

    Raise MissingInputError or DataError.
    """
    model = verify_model(name_or_path)
    metadata = model.metadata
    plain = {
        key: metadata[key] for key in ("stage", "seed", "dataset", "encoder") if key in metadata
    }
    sections = {key: metadata[key] for key in SECTIONS if isinstance(metadata.get(key), dict)}
    described = dotted(_summary(model)) | plain | dotted(sections)
    screen.table(f"Model {model.name}", ["", "value"], list(described.items()))
    return {**_summary(model), "metadata": metadata}


def verify(screen: Screen, names: list[str]) -> Result:
    """Check models against their sha256, all of the zoo if none is named.

    Say as well whether the measured curves beside a model are those of the present defaults, which
    ``eval`` and ``scale`` would otherwise measure again. Raise, after all of them, the error of
    the first that is damaged, unreadable or not there, which names the others too.
    """
    damaged: list[HjepaError] = []
    verified: list[Result] = []
    for name in names or list_models():
        try:
            model = verify_model(name)
            missing = missing_curves(model) if model.has_curves else None
        except HjepaError as error:
            damaged.append(error)
        else:
            verified.append(_summary(model) | {"missing_curves": missing})
            about = "" if missing is None else f"; {ALL_MEASURED}"
            if missing:
                about = f"; default curves to be measured again: {', '.join(missing)}"
            screen.result(f"{name}: intact, sha256 {model.digest}{about}")
    if damaged:
        raise together(damaged)
    return {"verified": verified}


def missing_curves(model: ZooModel) -> list[str]:
    """Return the default methods that ``curves.json`` lacks under the default protocol.

    A baseline holds none of them: of it, the method counts that it was trained for. Raise DataError
    for damaged curves or a model that cannot drive.
    """
    # These import torch: seconds that the other commands need not wait.
    from hjepa_cli.core.control.drivers import methods_of
    from hjepa_cli.core.evaluation import curves
    from hjepa_cli.core.networks.model import Model
    from hjepa_cli.stages.model_set import ModelSet, under_law_of

    plant = model.metadata.get("plant")
    held = Model.load(model.path)
    settings = under_law_of(held, load_settings(plant if plant in PRESETS else None))
    models = ModelSet(settings, held, model.path, None)
    offered = methods_of(held)
    wanted = settings.methods if "hjepa" in offered else offered[:1]
    found = curves.read(model.path.with_name(CURVES_FILE), models.digest, named=True)
    return [name for name in models.measurable(wanted) if name not in found]


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
    curves = "measured" if model["curves"] else "none"
    size = f"{model['size_bytes'] / 1e6:.1f}"
    named = [model[key] for key in ("name", "kind", "plant")]
    return [*named, strides, size, curves, model["sha256"][:12]]
