"""The routes of the view Model."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter(prefix="/api/model")
