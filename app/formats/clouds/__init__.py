"""Point clouds, each format of which can be made from the file of any other: LAS and LAZ, PCD, PLY."""

from app.formats.clouds import las, pcd, ply

__all__ = ["las", "pcd", "ply"]
