"""The routes of the view Results."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter(prefix="/api/results")
