"""Write path: uploaded bytes or edits -> layers -> one version and its event, in one transaction.

``prepare`` runs in a worker process (it parses untrusted bytes and computes); ``service`` commits the result.
"""

from app.ingest.alignment import AlignmentRequest
from app.ingest.commit_request import CommitRequest
from app.ingest.derivation import DerivationRequest
from app.ingest.drafts import RebaseResult, check_draft_match
from app.ingest.edits import check_depth
from app.ingest.generation import GenerationRequest
from app.ingest.merging import MergeRequest
from app.ingest.online import Provider
from app.ingest.service import CommitResult, Ingest, SpooledFile, Upload, dry_run_as_json
from app.ingest.templates import TemplateUpdate

__all__ = [
    "AlignmentRequest",
    "CommitRequest",
    "CommitResult",
    "DerivationRequest",
    "GenerationRequest",
    "Ingest",
    "MergeRequest",
    "Provider",
    "RebaseResult",
    "SpooledFile",
    "TemplateUpdate",
    "Upload",
    "check_depth",
    "check_draft_match",
    "dry_run_as_json",
]
