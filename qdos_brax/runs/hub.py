"""Exported runs on a hub: ``hub:USER/NAME`` in the place of a file, fetched and kept by huggingface-hub."""

from __future__ import annotations

import re
from pathlib import Path

from qdos_brax.errors import UserError

FILE_NAME = "qdos.safetensors"
"""What an exported run is called in a repository of its own."""

_PREFIX = "hub:"
_ADDRESS = re.compile(r"hub:(?P<repository>[^/@]+/[^/@]+)(/(?P<file>[^@]+))?(@(?P<revision>.+))?")


def local_path(name: str) -> Path:
    """Return the path that a run or a file is at on this machine.

    Args:
        name: a path, or ``hub:USER/NAME[/FILE][@REVISION]``, a file (default ``qdos.safetensors``) of a model
            repository on the hub at HF_ENDPOINT. It is fetched once; without a connection the copy of before is taken.

    Raises:
        UserError: the address is no such address, huggingface-hub is not installed, or it does not get the file.
    """
    if not name.startswith(_PREFIX):
        return Path(name)
    address = _ADDRESS.fullmatch(name)
    if address is None:
        raise UserError(f"{name} is no address on a hub; write hub:USER/NAME, hub:USER/NAME/FILE or ..@REVISION")
    try:
        from huggingface_hub import hf_hub_download
    except ImportError as error:
        raise UserError(f'{name} needs huggingface-hub; run: pip install -c constraints.txt -e ".[hub]"') from error
    try:
        file = address["file"] or FILE_NAME
        return Path(hf_hub_download(address["repository"], file, revision=address["revision"]))
    except Exception as error:  # the errors of server, connection, cache and checks have no base of their own
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"{name} cannot be fetched ({reason})") from error
