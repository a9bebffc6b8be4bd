"""One exported model serves all tests of the wire: exporting takes most of their time."""

from pathlib import Path

import pytest

MODEL = "desktop-h4m2l1"


@pytest.fixture(scope="session")
def checkpoint():
    from hjepa_cli.storage import zoo

    return zoo.resolve_model(MODEL)


@pytest.fixture(scope="session")
def exported(checkpoint, tmp_path_factory) -> Path:
    for module in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(module)
    from hjepa_cli.wire.export import export

    directory = tmp_path_factory.mktemp("exported")
    export(checkpoint, directory, None)
    return directory
