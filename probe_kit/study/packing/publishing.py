"""Publishing of a data set on the Hugging Face hub."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from probe_kit.errors import StoreError
from probe_kit.study.packing.data_set import data_set_version

TRIES = 5
"""Of an upload that a server refuses for now, or whose connection breaks."""
_PAUSE = 2.0
_FOR_NOW = (408, 425, 429, 500, 502, 503, 504)


def publish_data_set(
    folder: Path, repository: str, pull_request: bool = False, private: bool = False, pause: float = _PAUSE
) -> str:
    """Upload a folder of `write_data_set` as a data set; returns the address of the commit or pull request.

    repository: `owner/name`, created if it is not there. The commit is tagged with the version of its content, a
    pull request is not. The token is the hub's own: HF_TOKEN, or that of `hf auth login`. Files that are there
    already are not sent again. pause: seconds before the second try, doubled each time.
    Raises StoreError where the hub refuses, or cannot be reached in TRIES tries.
    """
    from huggingface_hub import DiscussionWithDetails, HfApi

    api = HfApi(endpoint=os.environ.get("HF_ENDPOINT"), library_name="probe-kit")
    version = data_set_version(folder)

    opened: list[DiscussionWithDetails] = []  # kept between tries, so that no second one is opened

    def upload() -> str:
        if pull_request and not opened:
            opened.append(api.create_pull_request(repository, f"probe_kit study {version}", repo_type="dataset"))
        if not pull_request:
            api.create_repo(repository, repo_type="dataset", private=private or None, exist_ok=True)
        made = api.upload_folder(
            repo_id=repository,
            repo_type="dataset",
            folder_path=folder,
            commit_message=f"probe_kit study {version}",
            revision=opened[0].git_reference if opened else None,
        )
        if opened:
            return opened[0].url
        api.create_tag(repository, tag=version, repo_type="dataset", exist_ok=True)
        return str(made.commit_url)

    return _tried(upload, repository, pause)


def _tried(upload: Callable[[], str], repository: str, pause: float) -> str:
    """The result of an upload that may need several tries."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError

    for attempt in range(TRIES):
        try:
            return upload()
        except (HfHubHTTPError, httpx.TransportError) as error:
            answer = getattr(error, "response", None)
            status = None if answer is None else answer.status_code
            if status is not None and status not in _FOR_NOW:
                advice = (
                    "Log in with `hf auth login`" if status in (401, 403) else "Check the name of the repository"
                )
                raise StoreError(f"the hub refuses {repository}: status {status}. {advice}") from error
            if attempt == TRIES - 1:
                said = f"status {status}" if status else type(error).__name__
                raise StoreError(f"{repository} could not be uploaded in {TRIES} tries ({said})") from error
        time.sleep(pause * 2**attempt)
    raise AssertionError("every try returns or raises")
