"""``hjepa models list | info | verify``: what a trained model is, and whether it is intact."""

from typing import Any

from hjepa_cli.errors import DataError, HjepaError
from hjepa_cli.screen import Screen
from hjepa_cli.storage.zoo import ZooModel, list_models, verify_model

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
    rows: list[list[object]] = [[key, value] for key, value in _flat(_summary(model))]
    for key in ("stage", "seed", "dataset", "encoder"):
        if key in metadata:
            rows.append([key, metadata[key]])
    for section in ("architecture", "health", "versions"):
        rows += [[f"{section}.{key}", value] for key, value in _flat(metadata.get(section))]
    screen.table(f"Model {model.name}", ["", "value"], rows)
    return {**_summary(model), "metadata": metadata}


def verify(screen: Screen, names: list[str]) -> Result:
    """Check models against their sha256, all of the zoo if none is named.

    Raises:
        MissingInputError: no such model.
        DataError: at least one is damaged; the others are still checked and reported.
    """
    damaged = []
    verified = []
    for name in names or list_models():
        try:
            model = verify_model(name)
        except DataError as error:
            damaged.append(error)
        else:
            verified.append(_summary(model))
            screen.result(f"{name}: intact, sha256 {model.digest}")
    for further in damaged[1:]:
        screen.say(further.message)
    if damaged:
        raise damaged[0]
    return {"verified": verified}


def _summary(model: ZooModel) -> Result:
    architecture = model.metadata.get("architecture")
    if not isinstance(architecture, dict):
        raise DataError(f"{model.path} does not say what it is: no architecture")
    return {
        "name": model.name,
        "path": str(model.path),
        "kind": architecture.get("kind"),
        "plant": model.metadata.get("plant"),
        "strides": {key: architecture.get(key) for key in ("h", "m", "l")},
        "size_bytes": model.size_bytes,
        "curves": model.has_curves,
        "sha256": model.digest,
    }


def _row(model: Result) -> list[object]:
    if "error" in model:
        return [model["name"], f"damaged: {model['error']}", "", "", None, "", ""]
    strides = "/".join(str(stride) for stride in model["strides"].values())
    megabytes = f"{model['size_bytes'] / 1e6:.1f}"
    curves = "measured" if model["curves"] else "none"
    return [
        model["name"], model["kind"], model["plant"], strides, megabytes, curves,
        model["sha256"][:12],
    ]  # fmt: skip


def _flat(values: object, prefix: str = "") -> list[tuple[str, object]]:
    """Nested metadata as (dotted key, value) pairs."""
    if not isinstance(values, dict):
        return []
    pairs: list[tuple[str, object]] = []
    for key, value in values.items():
        nested = isinstance(value, dict)
        pairs += _flat(value, f"{prefix}{key}.") if nested else [(prefix + key, value)]
    return pairs
