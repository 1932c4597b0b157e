"""The routes of the view Identification."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter(prefix="/api/identification")
