"""Sources of updates: a bundle (one file), a folder, or a web server; each is a fetcher for TUF's client.

A repository is a folder with ``metadata`` and ``targets``. A bundle is the part of it that one vehicle needs: a JSON
object of names and texts, compressed as XZ, whose checksum notices any byte that was changed on the way. Sizes are
limited here, and again, file by file, by TUF's client.
"""

import errno
import lzma
import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing
from pathlib import Path, PurePosixPath
from typing import cast
from urllib.parse import quote

import msgspec
from tuf.api.exceptions import DownloadError, DownloadHTTPError, SlowRetrievalError
from tuf.ngclient import FetcherInterface
from tuf.ngclient.urllib3_fetcher import Urllib3Fetcher

from ecu_node.core.status import Reason, TrustError
from ecu_node.documents import UnsuitableFileError, read_user_file

__all__ = ["bundle_bytes", "open_source"]

_LARGEST_BUNDLE_BYTES = 1_000_000
_LARGEST_TEXT_BYTES = 8_000_000
"""Largest size of all files of a bundle together; decompression stops there."""
_LARGEST_FILE_BYTES = 5_000_000
"""Largest file that is read from a folder; TUF's client allows less for most files."""
_MOST_MEMORY_BYTES = 64_000_000
"""Most memory that the decompressor may take."""
_LONGEST_DOWNLOAD_S = 300.0
"""Longest time for one file from a web server. [s]"""


def open_source(text: str) -> FetcherInterface:
    """Open a source of updates.

    Parameters
    ----------
    text : str
        Path of a bundle, folder of a repository, or URL of a repository (http or https).

    Returns
    -------
    FetcherInterface
        Fetcher for TUF's client; takes names such as ``metadata/timestamp.json``.

    Raises
    ------
    TrustError
        If there is no such file or folder, or the file is not a complete bundle.
    """
    if text.startswith(("http://", "https://")):
        return _WebFetcher(text.rstrip("/"))
    if "://" in text:
        raise TrustError(Reason.NO_PARAMETERS, f"{text}: only http:// and https:// are known; name a bundle or folder")
    path = Path(text)
    if (path / "metadata").is_dir():
        return _FolderFetcher(path)
    if path.is_dir():
        raise TrustError(Reason.NO_PARAMETERS, f"{text}: no repository: there is no folder 'metadata' in it")
    return _BundleFetcher(_bundle_files(path))


def bundle_bytes(files: Mapping[str, bytes]) -> bytes:
    """Pack files of a repository, by their names such as ``metadata/timestamp.json``, into a bundle."""
    texts = {name: content.decode() for name, content in files.items()}
    return lzma.compress(msgspec.json.encode(texts), check=lzma.CHECK_SHA256)


def _bundle_files(path: Path) -> dict[str, str]:
    """Return the files of a bundle, as texts by name; raise TrustError if it is not whole."""
    try:
        content = read_user_file(path, largest_bytes=_LARGEST_BUNDLE_BYTES)
    except UnsuitableFileError as error:
        raise TrustError(Reason.MALFORMED_PARAMETERS, f"{path}: {error}; a bundle is expected") from None
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else "no file has such a name"
        raise TrustError(Reason.NO_PARAMETERS, f"{path}: cannot be read: {why}; name a bundle, folder or URL") from None
    try:
        reader = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MOST_MEMORY_BYTES)
        text = reader.decompress(content, _LARGEST_TEXT_BYTES)
        if not reader.eof or reader.unused_data or reader.check != lzma.CHECK_SHA256:
            raise lzma.LZMAError("something is missing, or too much is there")
        return msgspec.json.decode(text, type=dict[str, str])
    except (lzma.LZMAError, msgspec.DecodeError, UnicodeDecodeError) as error:
        raise TrustError(
            Reason.MALFORMED_PARAMETERS,
            f"{path}: not a whole bundle: {error}; one of 'calibrator repository bundle' is expected",
        ) from None


class _BundleFetcher(FetcherInterface):
    """Fetches from the files of a bundle."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self._files = files

    def _fetch(self, url: str) -> Iterator[bytes]:
        if url not in self._files:
            names = [PurePosixPath(name).name.partition(".")[2] for name in self._files if name.startswith("targets/")]
            raise DownloadHTTPError(f"{url} is not in the bundle, which has {' '.join(names) or 'no parameters'}", 404)
        return iter([self._files[url].encode(errors="surrogatepass")])


class _FolderFetcher(FetcherInterface):
    """Fetches from the folder of a repository."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def _fetch(self, url: str) -> Iterator[bytes]:
        if ".." in PurePosixPath(url).parts:
            raise DownloadHTTPError(f"{url} leads out of the repository", 404)
        try:
            return iter([read_user_file(self._folder / url, largest_bytes=_LARGEST_FILE_BYTES)])
        except OSError as error:
            if error.errno in (errno.ENOENT, errno.ENOTDIR):
                raise DownloadHTTPError(f"{url} is not in the folder", 404) from None
            raise DownloadError(f"{url}: {error.strerror}") from None


class _WebFetcher(Urllib3Fetcher):
    """Fetches from a web server, and gives up if a file takes too long; TUF's own limit is on each read only."""

    def __init__(self, base: str) -> None:
        super().__init__()
        self._base = base

    def _fetch(self, url: str) -> Iterator[bytes]:
        end_s = time.monotonic() + _LONGEST_DOWNLOAD_S
        chunks = super()._fetch(f"{self._base}/{quote(url)}")  # file names may contain a %, as V%201.json does
        with closing(cast("Generator[bytes]", chunks)):  # returns the connection to its pool
            for chunk in chunks:
                if time.monotonic() > end_s:
                    raise SlowRetrievalError(f"{url} took longer than {_LONGEST_DOWNLOAD_S:g} s")
                yield chunk
