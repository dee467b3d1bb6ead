"""WRITE: bytes or edits -> layers -> one version, with its event, in one transaction; or nothing.

``prepare`` runs in a worker process (it reads hostile bytes and computes); ``service`` commits what it found.
"""

from app.ingest.alignment import Alignment
from app.ingest.derivation import Wish
from app.ingest.generation import Order
from app.ingest.online import Provider
from app.ingest.service import Ingest, Outcome, SpooledFile, Upload
from app.ingest.templates import TemplateWish

__all__ = ["Alignment", "Ingest", "Order", "Outcome", "Provider", "SpooledFile", "TemplateWish", "Upload", "Wish"]
