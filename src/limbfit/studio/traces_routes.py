"""The routes of the view Traces."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter(prefix="/api/traces")
