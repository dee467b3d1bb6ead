"""WRITE: bytes or edits -> layers -> one version, with its event, in one transaction; or nothing.

``prepare`` runs in a worker process (it reads hostile bytes and computes); ``service`` commits what it found.
"""

from app.ingest.alignment import AlignmentRequest
from app.ingest.commit_request import CommitRequest
from app.ingest.derivation import DerivationRequest
from app.ingest.generation import GenerationRequest
from app.ingest.online import Provider
from app.ingest.service import CommitResult, Ingest, SpooledFile, Upload
from app.ingest.templates import TemplateUpdate

__all__ = [
    "AlignmentRequest",
    "CommitRequest",
    "CommitResult",
    "DerivationRequest",
    "GenerationRequest",
    "Ingest",
    "Provider",
    "SpooledFile",
    "TemplateUpdate",
    "Upload",
]
