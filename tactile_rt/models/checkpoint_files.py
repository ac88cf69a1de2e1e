"""What a checkpoint says of itself, read without torch: is it one, of which network, of what data?

torch writes an archive: a pickle of everything but the numbers of tensors, which lie beside it. The
numbers are left where they are, and nothing but plain values is made of the pickle.
"""

import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

from tactile_rt.core.errors import ModelError
from tactile_rt.core.files import open_regular
from tactile_rt.core.stream import ArraySpec
from tactile_rt.models.ead_config import EADConfig

__all__ = ["NETWORK", "describe_checkpoint", "network_of", "no_checkpoint", "reason"]

PICKLE = "/data.pkl"  # in the archive, in a folder of any name
NEEDED = ("model", "network", "config", "spec", "categories", "refusals")
# of a network's configuration, what a training configuration says
NETWORK = (
    "encoder", "attender", "decoder", "width", "readout", "dropout", "graph", "norm_epsilon",
    "preprocessing",
)  # fmt: skip


def describe_checkpoint(path: Path) -> dict[str, Any]:
    """What a `best.pt` holds; every tensor is None.

    Raises:
        ModelError: not there, or no such checkpoint, as far as can be told without its numbers.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            names = [name for name in archive.namelist() if name.endswith(PICKLE)]
            if not names:
                raise ModelError("it is another archive")
            with archive.open(names[0]) as pickled:
                saved = _WithoutTensors(pickled).load()
        missing = [key for key in NEEDED if key not in saved]
        if missing:  # of last.pt, for one
            raise ModelError(f"it has no {missing[0]}, which a best.pt has")
        EADConfig(**saved["network"])
        ArraySpec.from_json(saved["spec"])
    except FileNotFoundError:
        raise ModelError(f"no checkpoint {path}") from None
    except Exception as error:  # zipfile and pickle raise many unrelated types for a damaged file
        raise no_checkpoint(path, error) from None
    found: dict[str, Any] = saved
    return found


def network_of(path: Path) -> dict[str, Any]:
    """What a training configuration says of the network of a checkpoint."""
    network = describe_checkpoint(path)["network"]
    return {key: value for key, value in network.items() if key in NETWORK}


def no_checkpoint(path: Path, error: Exception) -> ModelError:
    """The error to raise of a file that is no checkpoint."""
    return ModelError(f"{path} is not a checkpoint of `tactile-rt train`: {reason(error)}")


def reason(error: Exception) -> str:
    """An error in one line."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error).splitlines()[0] if str(error) else type(error).__name__


class _WithoutTensors(pickle.Unpickler):
    def persistent_load(self, pid: Any) -> None:
        """The numbers of a tensor."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module.partition(".")[0] == "torch":
            return _nothing
        raise ModelError(f"it asks for {module}.{name}")


def _nothing(*_: Any) -> None:
    """A tensor."""
