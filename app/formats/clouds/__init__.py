"""Point cloud formats, convertible into each other: LAS and LAZ, PCD, PLY."""

from app.formats.clouds import las, pcd, ply

__all__ = ["las", "pcd", "ply"]
