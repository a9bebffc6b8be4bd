"""``hjepa export`` writes a model for ``serve`` and ``device``, which run without torch.

Checkpoint → ONNX networks and a manifest → the same pictures through both → the differences.
"""

from pathlib import Path
from typing import Any

from hjepa_cli.errors import DataError, UsageError, shell
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.plan import Plan
from hjepa_cli.storage import zoo
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.wire import export as exports
from hjepa_cli.wire.bundle import CHECK, MANIFEST, Bundle, open_bundle


def run(
    screen: Screen,
    *,
    name_or_path: str | None = None,
    to: Path | None = None,
    check: Path | None = None,
    method: str | None = None,
    backend: str = "onnxruntime",
) -> dict[str, Any]:
    """Export a model and check it, or check one that is exported; return the ``--json`` document.

    Args:
        screen: shows the differences.
        name_or_path: zoo name or path of the model.
        to: directory to write to.
        check: exported model to check, against ``name_or_path`` or the zoo's model of its digest.
        method: what plans the strides.
        backend: what the check computes with.

    Raises:
        UsageError: neither or both of ``to`` and ``check``, or no such method.
        NumericalError: what was exported computes something else.
    """
    path = source(name_or_path, to, check)
    if check is not None:
        bundle = open_bundle(check)
    else:
        assert to is not None
        exports.exportable(path, to, method)  # refused before it is said to take its time
        screen.say(f"exporting {path}, which takes up to a minute")
        bundle = exports.export(path, to, method)
    measured = exports.check(bundle, path, backend)
    screen.table(
        f"{bundle.directory} against torch in fp32, {measured['n']} pictures, {backend}",
        ["what", "largest error"],
        [[name, f"{error:.1e}"] for name, error in measured["max_error"].items()]
        + [[f"int8 {name}", f"{error:.2e}"] for name, error in measured["int8"].items()],
    )
    return {
        "directory": bundle.directory,
        "digest": bundle.digest.hex(),
        "plant": bundle.plant,
        "method": bundle.manifest["method"],
        "checkpoint": path,
        **measured,
    }


def plan(
    *,
    name_or_path: str | None = None,
    to: Path | None = None,
    check: Path | None = None,
    method: str | None = None,
) -> Plan:
    """Plan an export or a check; arguments and errors as of :func:`run`."""
    path = source(name_or_path, to, check)
    if check is not None:
        work = [f"compare it with torch on {exports.CHECKED} pictures"]
        return Plan("export", [str(check), str(path)], work, [f"{check}/{CHECK}"], 1000, 15.0)
    assert to is not None
    exports.exportable(path, to, method)
    work = ["write its networks as ONNX", f"compare them on {exports.CHECKED} pictures"]
    return Plan("export", [str(path)], work, [f"{to}/{MANIFEST}, networks"], 15_000_000, 60.0)


def source(name_or_path: str | None, to: Path | None, check: Path | None) -> Path:
    """Return the checkpoint to export, or to check an exported model against.

    Raises:
        UsageError: neither or both of ``to`` and ``check``, or nothing to export.
    """
    if (to is None) == (check is None):
        raise UsageError(
            "give --to DIR to export a model, or --check DIR to check one that is exported",
            hint="hjepa export desktop-h4m2l1 --to exported",
        )
    if name_or_path is not None:
        return zoo.resolve_model(name_or_path)
    if check is None:
        raise UsageError("which model? name one of the zoo or a path", hint="hjepa models list")
    return checkpoint_of(open_bundle(check))


def checkpoint_of(bundle: Bundle) -> Path:
    """Return the zoo's checkpoint that a bundle was exported from.

    Raises:
        DataError: the zoo has none of its digest.
    """
    wanted = bundle.manifest["checkpoint"]["sha256"]
    for path in map(zoo.resolve_model, zoo.list_models()):
        if load_checkpoint(path).digest == wanted:
            return path
    raise DataError(
        f"{bundle.directory} was exported from a checkpoint that the zoo does not hold: "
        f"{wanted[:12]}…",
        hint=f"name it: {shell(['hjepa', 'export', 'PATH', '--check', bundle.directory])}",
    )
