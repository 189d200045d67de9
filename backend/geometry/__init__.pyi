from .cad import PICTURE_PX as PICTURE_PX
from .cad import UNITS_MM as UNITS_MM
from .cad import CentreOfMass as CentreOfMass
from .cad import MeasuredPiece as MeasuredPiece
from .cad import PieceEnd as PieceEnd
from .cad import PieceImport as PieceImport
from .cad import PieceRole as PieceRole
from .cad import measure_piece as measure_piece
from .cad import piece_name as piece_name
from .cad import piece_svg as piece_svg
from .cad import save_piece as save_piece
from .families import FRESH_CLASSES as FRESH_CLASSES
from .families import FRESH_SEED as FRESH_SEED
from .families import FRESH_SOURCE as FRESH_SOURCE
from .families import UNSEEN_BOTTOMS as UNSEEN_BOTTOMS
from .families import UNSEEN_PIECES as UNSEEN_PIECES
from .families import UNTRAINED_CLASSES as UNTRAINED_CLASSES
from .families import OutlineKinds as OutlineKinds
from .families import ShapeFamily as ShapeFamily
from .families import fresh_bottom as fresh_bottom
from .outlines import BOARD_DOT_RADIUS_MM as BOARD_DOT_RADIUS_MM
from .outlines import BOARD_DOTS_MM as BOARD_DOTS_MM
from .outlines import Outline as Outline
from .outlines import Point as Point
from .outlines import circle as circle
from .outlines import contact_edges as contact_edges
from .outlines import contact_margins_mm as contact_margins_mm
from .outlines import convex_polygon as convex_polygon
from .outlines import edge_normals as edge_normals
from .outlines import edges_to_polygon as edges_to_polygon
from .outlines import enclosed_area_mm2 as enclosed_area_mm2
from .outlines import face_points as face_points
from .outlines import geometry_of as geometry_of
from .outlines import inset_mm as inset_mm
from .outlines import overlap_area_mm2 as overlap_area_mm2
from .outlines import overlap_edges as overlap_edges
from .outlines import overlap_polygon as overlap_polygon
from .outlines import polygon_edges as polygon_edges
from .outlines import polygon_of as polygon_of
from .outlines import rectangle as rectangle
from .outlines import rings_of as rings_of
from .outlines import rotated as rotated
from .outlines import signed_distances_mm as signed_distances_mm
from .outlines import square as square
from .outlines import true_patch as true_patch
from .pieces import LEAST_WEIGHED_G as LEAST_WEIGHED_G
from .pieces import PIECE_SOURCES as PIECE_SOURCES
from .pieces import Piece as Piece
from .pieces import PieceLibrary as PieceLibrary
from .pieces import load_pieces as load_pieces
from .pieces import pieces_folder as pieces_folder
from .regions import channel as channel
from .regions import convex_cells as convex_cells
from .regions import crescent as crescent
from .regions import ell as ell
from .regions import feet as feet
from .regions import region as region
from .regions import ring as ring
from .regions import star as star
from .regions import tee as tee
from .sampling import COARSE_SEGMENTS as COARSE_SEGMENTS
from .sampling import MIN_OVERLAP_MM2 as MIN_OVERLAP_MM2
from .sampling import can_be_placed as can_be_placed
from .sampling import draw_offset as draw_offset
from .sampling import draw_start as draw_start
from .sampling import draw_tower as draw_tower
from .sampling import scene_number as scene_number
from .sampling import start_generator as start_generator
from .sampling import with_true_com as with_true_com
from .surfaces import FLAT as FLAT
from .surfaces import PieceOnSurface as PieceOnSurface
from .surfaces import Surface as Surface
from .surfaces import spread_points as spread_points
from .surfaces import step_levels as step_levels
from .surfaces import surface_heights_mm as surface_heights_mm
from .tower import TOO_CLOSE_MM as TOO_CLOSE_MM
from .tower import Body as Body
from .tower import Tower as Tower
from .tower import TowerVerdict as TowerVerdict
from .tower import interface_overlap as interface_overlap
from .tower import judge_tower as judge_tower
from .tower import piece_on_surface as piece_on_surface

__all__ = [
    "BOARD_DOTS_MM",
    "BOARD_DOT_RADIUS_MM",
    "COARSE_SEGMENTS",
    "FLAT",
    "FRESH_CLASSES",
    "FRESH_SEED",
    "FRESH_SOURCE",
    "LEAST_WEIGHED_G",
    "MIN_OVERLAP_MM2",
    "PICTURE_PX",
    "PIECE_SOURCES",
    "TOO_CLOSE_MM",
    "UNITS_MM",
    "UNSEEN_BOTTOMS",
    "UNSEEN_PIECES",
    "UNTRAINED_CLASSES",
    "Body",
    "CentreOfMass",
    "MeasuredPiece",
    "Outline",
    "OutlineKinds",
    "Piece",
    "PieceEnd",
    "PieceImport",
    "PieceLibrary",
    "PieceOnSurface",
    "PieceRole",
    "Point",
    "ShapeFamily",
    "Surface",
    "Tower",
    "TowerVerdict",
    "can_be_placed",
    "channel",
    "circle",
    "contact_edges",
    "contact_margins_mm",
    "convex_cells",
    "convex_polygon",
    "crescent",
    "draw_offset",
    "draw_start",
    "draw_tower",
    "edge_normals",
    "edges_to_polygon",
    "ell",
    "enclosed_area_mm2",
    "face_points",
    "feet",
    "fresh_bottom",
    "geometry_of",
    "inset_mm",
    "interface_overlap",
    "judge_tower",
    "load_pieces",
    "measure_piece",
    "overlap_area_mm2",
    "overlap_edges",
    "overlap_polygon",
    "piece_name",
    "piece_on_surface",
    "piece_svg",
    "pieces_folder",
    "polygon_edges",
    "polygon_of",
    "rectangle",
    "region",
    "ring",
    "rings_of",
    "rotated",
    "save_piece",
    "scene_number",
    "signed_distances_mm",
    "spread_points",
    "square",
    "star",
    "start_generator",
    "step_levels",
    "surface_heights_mm",
    "tee",
    "true_patch",
    "with_true_com",
]
