//! Furniture and household objects, in metres, that image classifiers recognise. Each object stands
//! on y = 0 with its front towards +z.

use super::props::{BRASS, BuildFn, DARKER, Look, OWN, Piece, WOOD, piece};
use super::solid::Shape::{Ball, Block, Cone, Cylinder};
use glam::Vec3;
use std::f32::consts::{FRAC_PI_2, PI, TAU};

const BLACK: Look = Look::Painted(Vec3::new(0.07, 0.07, 0.08));
const STEEL: Look = Look::Painted(Vec3::new(0.62, 0.64, 0.67));
const WHITE: Look = Look::Painted(Vec3::new(0.93, 0.93, 0.92));
/// Colours of the book spines in a bookcase.
const SPINES: [Vec3; 7] = [
    Vec3::new(0.62, 0.13, 0.12),
    Vec3::new(0.13, 0.25, 0.5),
    Vec3::new(0.85, 0.78, 0.6),
    Vec3::new(0.16, 0.38, 0.22),
    Vec3::new(0.75, 0.5, 0.14),
    Vec3::new(0.3, 0.16, 0.32),
    Vec3::new(0.9, 0.88, 0.84),
];

/// An object with its position in the room.
pub struct Placed {
    pub name: &'static str,
    pub make: BuildFn,
    /// Colour of the pieces that have no colour of their own.
    pub color: Vec3,
    pub at: [f32; 3],
    /// Rotation around y in radians.
    pub yaw: f32,
}

/// Returns a round table with small objects on it and furniture around it.
pub fn study() -> [Placed; 11] {
    let [red, orange_peel, oak, teal] = [
        Vec3::new(0.75, 0.1, 0.1),
        Vec3::new(0.95, 0.5, 0.08),
        Vec3::new(0.42, 0.27, 0.15),
        Vec3::new(0.1, 0.42, 0.45),
    ];
    let top = 0.738;
    let placed = |name, make: BuildFn, color, at, yaw| Placed {
        name,
        make,
        color,
        at,
        yaw,
    };
    [
        placed("dining table", dining_table, oak, [0.0, 0.0, 0.0], 0.0),
        placed("table lamp", table_lamp, Vec3::ONE, [0.0, top, 0.0], 0.0),
        placed("orange", orange, orange_peel, [0.36, top, 0.12], 0.4),
        placed("coffee mug", coffee_mug, red, [-0.1, top, 0.38], 0.6),
        placed("candle", candle, Vec3::ONE, [-0.32, top, -0.2], 0.0),
        placed(
            "television",
            television,
            Vec3::ONE,
            [1.45, 0.0, -0.45],
            -FRAC_PI_2 + 0.3,
        ),
        placed("umbrella", umbrella, red, [-1.05, 0.0, 1.05], 0.0),
        placed("chair", chair, oak, [0.1, 0.0, 1.05], PI),
        placed("couch", couch, teal, [-1.45, 0.0, -0.5], FRAC_PI_2 - 0.3),
        placed(
            "potted plant",
            potted_plant,
            Vec3::ONE,
            [0.0, 0.0, -1.45],
            0.0,
        ),
        placed(
            "traffic light",
            traffic_light,
            Vec3::ONE,
            [1.15, 0.0, 1.1],
            0.8,
        ),
    ]
}

/// A wooden chair with four legs and a back of three slats.
fn chair() -> Vec<Piece> {
    let mut pieces = vec![
        piece(Block, [0.0, 0.45, 0.0], [0.21, 0.02, 0.21], WOOD),
        piece(Block, [0.0, 0.98, -0.2], [0.21, 0.04, 0.015], WOOD),
        piece(Block, [0.0, 0.82, -0.2], [0.2, 0.03, 0.012], WOOD),
        piece(Block, [0.0, 0.66, -0.2], [0.2, 0.03, 0.012], WOOD),
    ];
    for side in [-1.0, 1.0] {
        pieces.push(piece(
            Block,
            [side * 0.19, 0.215, 0.19],
            [0.02, 0.215, 0.02],
            DARKER,
        ));
        pieces.push(piece(
            Block,
            [side * 0.19, 0.51, -0.2],
            [0.02, 0.51, 0.02],
            DARKER,
        ));
    }
    pieces
}

/// A couch with two seats, a back and two arms.
fn couch() -> Vec<Piece> {
    let mut pieces = vec![
        piece(Block, [0.0, 0.2, 0.0], [0.75, 0.12, 0.36], OWN),
        piece(Block, [0.0, 0.58, -0.3], [0.75, 0.28, 0.1], OWN),
    ];
    for side in [-1.0, 1.0] {
        pieces.push(piece(
            Block,
            [side * 0.36, 0.38, 0.05],
            [0.34, 0.075, 0.3],
            OWN,
        ));
        pieces.push(piece(
            Block,
            [side * 0.82, 0.36, 0.0],
            [0.1, 0.28, 0.38],
            OWN,
        ));
        for end in [-1.0, 1.0] {
            pieces.push(piece(
                Block,
                [side * 0.8, 0.04, end * 0.3],
                [0.03, 0.04, 0.03],
                BLACK,
            ));
        }
    }
    pieces
}

/// A plant with long leaves in a clay pot.
fn potted_plant() -> Vec<Piece> {
    let clay = Look::Painted(Vec3::new(0.68, 0.33, 0.2));
    let soil = Look::Painted(Vec3::new(0.16, 0.1, 0.07));
    let mut pieces = vec![
        piece(Cylinder, [0.0, 0.14, 0.0], [0.15, 0.14, 0.15], clay),
        piece(Cylinder, [0.0, 0.27, 0.0], [0.18, 0.03, 0.18], clay),
        piece(Cylinder, [0.0, 0.3, 0.0], [0.16, 0.004, 0.16], soil),
    ];
    for k in 0..22 {
        // The golden angle distributes the leaves evenly.
        let angle = 2.4 * k as f32;
        let rise = 0.2 + 0.6 * ((k * 7 % 22) as f32 / 21.0);
        let reach = 0.34 - 0.22 * rise;
        let green = Look::Painted(Vec3::new(0.1 + 0.06 * rise, 0.3 + 0.22 * rise, 0.1));
        let at = [reach * angle.cos(), 0.34 + 0.55 * rise, reach * angle.sin()];
        let tilt = [-0.9 * angle.cos(), 0.9 * angle.sin()];
        pieces.push(piece(Ball, at, [0.055, 0.17, 0.055], green).tilted(tilt[0], tilt[1]));
    }
    pieces.push(piece(Cylinder, [0.0, 0.5, 0.0], [0.02, 0.22, 0.02], DARKER));
    pieces
}

/// Half extents of the bare room in metres.
pub const BARE_ROOM: Vec3 = Vec3::new(3.0, 1.3, 2.5);

/// Returns the furniture of the bare room. It stands along the walls.
pub fn bare_room() -> [Placed; 11] {
    let red = Vec3::new(0.75, 0.1, 0.1);
    let Vec3 { x, z, .. } = BARE_ROOM;
    let placed = |name, make: BuildFn, at, yaw| Placed {
        name,
        make,
        color: red,
        at,
        yaw,
    };
    let table = [x - 0.9, z - 0.9];
    [
        placed("bookcase", bookcase, [-0.9, 0.0, 0.2 - z], 0.0),
        placed("picture", picture, [1.1, 0.0, 0.03 - z], 0.0),
        placed("television", television, [x - 0.25, 0.0, -0.9], -FRAC_PI_2),
        placed("dining table", dining_table, [table[0], 0.0, table[1]], 0.0),
        placed("table lamp", table_lamp, [table[0], 0.738, table[1]], 0.0),
        placed(
            "coffee mug",
            coffee_mug,
            [table[0] - 0.35, 0.738, table[1] - 0.2],
            2.0,
        ),
        placed("door", door, [-0.6, 0.0, z - 0.03], PI),
        placed("umbrella", umbrella, [0.6 - x, 0.0, z - 0.6], 0.0),
        placed(
            "washing machine",
            washing_machine,
            [0.32 - x, 0.0, 0.3],
            FRAC_PI_2,
        ),
        placed("window", window, [0.03 - x, 0.0, -1.2], FRAC_PI_2),
        placed("soccer ball", soccer_ball, [1.9, 0.0, 0.4 - z], 0.3),
    ]
}

/// A closed door with a handle.
fn door() -> Vec<Piece> {
    vec![
        piece(Block, [0.0, 1.0, 0.0], [0.45, 1.0, 0.03], WOOD),
        piece(Block, [0.37, 1.02, 0.05], [0.05, 0.012, 0.012], STEEL),
    ]
}

/// A window with a cross of bars, at eye level.
fn window() -> Vec<Piece> {
    let sky = Look::Fixed(Vec3::new(0.55, 0.7, 0.85));
    let bar = |half: [f32; 3]| piece(Block, [0.0, 1.5, 0.03], half, WHITE);
    vec![
        piece(Block, [0.0, 1.5, 0.0], [0.6, 0.5, 0.03], sky),
        bar([0.6, 0.03, 0.02]),
        bar([0.03, 0.5, 0.02]),
    ]
}

/// A picture with four fields of colour, at eye level.
fn picture() -> Vec<Piece> {
    let field = |k: usize| {
        let side = |bit: usize| if k & bit == 0 { -0.2 } else { 0.2 };
        let at = [side(1), 1.5 + 0.75 * side(2), 0.025];
        piece(Block, at, [0.2, 0.15, 0.01], Look::Painted(SPINES[k + 1]))
    };
    let frame = piece(Block, [0.0, 1.5, 0.0], [0.45, 0.35, 0.02], BLACK);
    std::iter::once(frame).chain((0..4).map(field)).collect()
}

/// A bookcase full of books.
fn bookcase() -> Vec<Piece> {
    let (width, height, depth, shelves) = (0.5, 1.7, 0.16, 5);
    let mut pieces = vec![piece(
        Block,
        [0.0, 0.5 * height, -0.9 * depth],
        [width, 0.5 * height, 0.012],
        WOOD,
    )];
    pieces.extend([-1.0, 1.0].map(|side| {
        piece(
            Block,
            [side * width, 0.5 * height, 0.0],
            [0.02, 0.5 * height, depth],
            WOOD,
        )
    }));
    let shelf_spacing = height / shelves as f32;
    let mut book = 0;
    for shelf in 0..=shelves {
        let floor = shelf as f32 * shelf_spacing;
        pieces.push(piece(
            Block,
            [0.0, floor.max(0.015), 0.0],
            [width, 0.015, depth],
            WOOD,
        ));
        let mut x = -width + 0.03;
        while shelf < shelves && x < width - 0.06 {
            // Heights and widths of the books have different periods, so that the pattern does not
            // repeat soon.
            let (thick, tall) = (
                0.014 + 0.006 * (book * 5 % 4) as f32,
                0.1 + 0.012 * (book * 7 % 5) as f32,
            );
            let look = Look::Painted(SPINES[book * 3 % SPINES.len()]);
            pieces.push(piece(
                Block,
                [x + thick, floor + 0.015 + tall, -0.01],
                [thick, tall, 0.8 * depth],
                look,
            ));
            x += 2.0 * thick + 0.004;
            book += 1;
        }
    }
    pieces
}

/// A dark screen with a frame on a low cabinet.
fn television() -> Vec<Piece> {
    let screen = Look::Painted(Vec3::new(0.16, 0.22, 0.3));
    vec![
        piece(Block, [0.0, 0.2, 0.0], [0.55, 0.2, 0.2], WOOD),
        piece(Block, [0.0, 0.42, 0.0], [0.2, 0.02, 0.1], BLACK),
        piece(Block, [0.0, 0.47, -0.02], [0.04, 0.05, 0.02], BLACK),
        piece(Block, [0.0, 0.82, 0.0], [0.56, 0.33, 0.03], BLACK),
        piece(Block, [0.0, 0.83, 0.02], [0.53, 0.295, 0.015], screen),
    ]
}

/// A white box with a round window.
fn washing_machine() -> Vec<Piece> {
    let glass = Look::Painted(Vec3::new(0.12, 0.15, 0.19));
    let disc = |radius: f32, z: f32, thick: f32, look: Look| {
        piece(Cylinder, [0.0, 0.4, z], [radius, thick, radius], look).tilted(0.0, FRAC_PI_2)
    };
    vec![
        piece(Block, [0.0, 0.43, 0.0], [0.3, 0.43, 0.29], WHITE),
        disc(0.2, 0.295, 0.015, STEEL),
        disc(0.155, 0.3, 0.02, glass),
        piece(Block, [0.0, 0.79, 0.292], [0.29, 0.055, 0.005], STEEL),
        piece(Block, [-0.18, 0.79, 0.298], [0.09, 0.03, 0.004], WHITE),
        piece(Cylinder, [0.12, 0.79, 0.3], [0.035, 0.015, 0.035], WHITE).tilted(0.0, FRAC_PI_2),
        piece(Block, [0.22, 0.79, 0.298], [0.04, 0.015, 0.004], BLACK),
    ]
}

/// Three vertically stacked lights on a pole.
fn traffic_light() -> Vec<Piece> {
    let mut pieces = vec![
        piece(Cylinder, [0.0, 0.03, 0.0], [0.16, 0.03, 0.16], STEEL),
        piece(Cylinder, [0.0, 0.45, 0.0], [0.035, 0.42, 0.035], STEEL),
        piece(Block, [0.0, 1.2, 0.0], [0.15, 0.38, 0.1], BLACK),
    ];
    let lights = [
        (1.45, Vec3::new(1.0, 0.12, 0.08)),
        (1.2, Vec3::new(0.45, 0.33, 0.05)),
        (0.95, Vec3::new(0.04, 0.25, 0.1)),
    ];
    for (y, color) in lights {
        // The lights are visible from both sides.
        for side in [-1.0, 1.0] {
            pieces.push(
                piece(
                    Cylinder,
                    [0.0, y, side * 0.1],
                    [0.1, 0.012, 0.1],
                    Look::Painted(color),
                )
                .tilted(0.0, FRAC_PI_2),
            );
            pieces.push(piece(
                Block,
                [0.0, y + 0.1, side * 0.15],
                [0.11, 0.012, 0.05],
                BLACK,
            ));
        }
    }
    pieces
}

/// A ball with black pentagons and white hexagons.
fn soccer_ball() -> Vec<Piece> {
    vec![piece(Ball, [0.0, 0.2, 0.0], [0.2; 3], Look::Football)]
}

/// A lamp with a foot, a pole and a shade.
fn table_lamp() -> Vec<Piece> {
    // The shade is a stack of discs, because a cone would end in a tip.
    let mut pieces = vec![
        piece(Cylinder, [0.0, 0.012, 0.0], [0.09, 0.012, 0.09], BRASS),
        piece(Cylinder, [0.0, 0.18, 0.0], [0.014, 0.17, 0.014], BRASS),
    ];
    for step in 0..8 {
        let share = step as f32 / 7.0;
        let glow = Vec3::new(1.0, 0.93, 0.72).lerp(Vec3::new(0.92, 0.8, 0.58), share);
        pieces.push(piece(
            Cylinder,
            [0.0, 0.31 + 0.022 * step as f32, 0.0],
            [0.17 - 0.09 * share, 0.0115, 0.17 - 0.09 * share],
            Look::Painted(glow),
        ));
    }
    pieces
}

/// An orange with its stem.
fn orange() -> Vec<Piece> {
    vec![
        piece(Ball, [0.0, 0.075, 0.0], [0.078, 0.075, 0.078], OWN),
        piece(
            Cylinder,
            [0.0, 0.15, 0.0],
            [0.008, 0.006, 0.008],
            Look::Fixed(Vec3::new(0.25, 0.4, 0.15)),
        ),
    ]
}

/// A mug of coffee with a handle.
fn coffee_mug() -> Vec<Piece> {
    let mut pieces = vec![
        piece(Cylinder, [0.0, 0.075, 0.0], [0.062, 0.075, 0.062], OWN),
        piece(
            Cylinder,
            [0.0, 0.147, 0.0],
            [0.056, 0.004, 0.056],
            Look::Fixed(Vec3::new(0.2, 0.1, 0.05)),
        ),
    ];
    for k in 0..9 {
        let angle = FRAC_PI_2 - PI * k as f32 / 8.0;
        let at = [
            0.062 + 0.045 * angle.cos(),
            0.078 + 0.048 * angle.sin(),
            0.0,
        ];
        pieces.push(piece(Block, at, [0.006, 0.012, 0.012], OWN).tilted(angle, 0.0));
    }
    pieces
}

/// A burning candle in a holder.
fn candle() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.01, 0.0], [0.085, 0.01, 0.085], BRASS),
        piece(Cylinder, [0.0, 0.14, 0.0], [0.035, 0.12, 0.035], WHITE),
        piece(Cylinder, [0.0, 0.27, 0.0], [0.004, 0.012, 0.004], BLACK),
        piece(
            Ball,
            [0.0, 0.305, 0.0],
            [0.014, 0.03, 0.014],
            Look::Fixed(Vec3::new(1.0, 0.8, 0.25)),
        ),
    ]
}

/// A round table.
fn dining_table() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.7, 0.0], [0.62, 0.025, 0.62], WOOD),
        piece(Cylinder, [0.0, 0.36, 0.0], [0.05, 0.33, 0.05], WOOD),
        piece(Cone, [0.0, 0.06, 0.0], [0.3, 0.06, 0.3], WOOD),
        piece(Cylinder, [0.0, 0.73, 0.0], [0.6, 0.008, 0.6], DARKER),
    ]
}

/// An open umbrella on a pole: a cone with a small ball at the end of each rib.
fn umbrella() -> Vec<Piece> {
    let mut pieces = vec![
        piece(Cylinder, [0.0, 0.6, 0.0], [0.018, 0.6, 0.018], STEEL),
        piece(Cylinder, [0.0, 0.03, 0.0], [0.2, 0.03, 0.2], STEEL),
        piece(Cone, [0.0, 1.3, 0.0], [0.55, 0.2, 0.55], OWN),
    ];
    for k in 0..8 {
        let angle = TAU * k as f32 / 8.0;
        pieces.push(piece(
            Ball,
            [0.54 * angle.cos(), 1.11, 0.54 * angle.sin()],
            [0.02; 3],
            BLACK,
        ));
    }
    pieces
}
