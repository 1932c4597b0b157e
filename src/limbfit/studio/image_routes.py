"""The routes of the view Image."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter(prefix="/api/image")
