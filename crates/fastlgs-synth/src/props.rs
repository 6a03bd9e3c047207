//! Objects to place in scenes. Each consists of solids, stands on y = 0 around the y axis, and is
//! about one unit high.

use super::solid::Shape::{self, Ball, Block, Cone, Cylinder};
use glam::Vec3;

/// One solid of an object.
pub struct Piece {
    /// Names of the part and subpart that contain the solid, outermost first; empty if it belongs
    /// directly to the object.
    pub part: Vec<String>,
    pub shape: Shape,
    pub centre: Vec3,
    pub half: Vec3,
    /// Rotations around z and around x in radians.
    pub tilt: [f32; 2],
    pub look: Look,
}

/// Appearance of a piece.
#[derive(Clone, Copy)]
pub enum Look {
    /// The object's colour times this factor.
    Own(f32),
    /// A fixed colour.
    Fixed(Vec3),
    /// A fixed colour with almost no grain.
    Painted(Vec3),
    /// Black pentagons and white hexagons of a football.
    Football,
}

/// A function that creates the pieces of an object.
pub type BuildFn = fn() -> Vec<Piece>;

/// Names of the catalogue objects and the functions that create them.
pub const CATALOGUE: [(&str, BuildFn); 12] = [
    ("mug", mug),
    ("ball", ball),
    ("book", book),
    ("bottle", bottle),
    ("lamp", lamp),
    ("bowl", bowl),
    ("candle", candle),
    ("box", crate_box),
    ("apple", apple),
    ("vase", vase),
    ("tower", tower),
    ("hat", hat),
];

/// Creates a piece that belongs directly to its object. `half` holds the half extents.
pub fn piece(shape: Shape, centre: [f32; 3], half: [f32; 3], look: Look) -> Piece {
    Piece {
        part: Vec::new(),
        shape,
        centre: centre.into(),
        half: half.into(),
        tilt: [0.0; 2],
        look,
    }
}

impl Piece {
    pub fn tilted(self, around_z: f32, around_x: f32) -> Self {
        Self {
            tilt: [around_z, around_x],
            ..self
        }
    }

    fn in_part(self, part: &[&str]) -> Self {
        Self {
            part: part.iter().map(|p| (*p).to_owned()).collect(),
            ..self
        }
    }
}

/// The object's own colour.
pub const OWN: Look = Look::Own(1.0);
/// A darker shade of the object's own colour.
pub const DARKER: Look = Look::Own(0.55);
pub const BRASS: Look = Look::Fixed(Vec3::new(0.75, 0.6, 0.25));
pub const WOOD: Look = Look::Fixed(Vec3::new(0.5, 0.33, 0.18));
const LEAF: Look = Look::Fixed(Vec3::new(0.2, 0.55, 0.2));
const CREAM: Look = Look::Fixed(Vec3::new(0.95, 0.9, 0.8));

pub fn mug() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.45, 0.0], [0.38, 0.45, 0.38], OWN).in_part(&["cup"]),
        piece(Block, [0.48, 0.7, 0.0], [0.14, 0.05, 0.07], DARKER).in_part(&["handle"]),
        piece(Block, [0.58, 0.45, 0.0], [0.05, 0.3, 0.07], DARKER).in_part(&["handle"]),
        piece(Block, [0.48, 0.2, 0.0], [0.14, 0.05, 0.07], DARKER).in_part(&["handle"]),
    ]
}

fn ball() -> Vec<Piece> {
    vec![piece(Ball, [0.0, 0.45, 0.0], [0.45; 3], OWN)]
}

fn book() -> Vec<Piece> {
    vec![
        piece(Block, [0.0, 0.08, 0.0], [0.5, 0.08, 0.38], CREAM).in_part(&["pages"]),
        piece(Block, [0.0, 0.18, 0.0], [0.54, 0.025, 0.42], OWN).in_part(&["cover"]),
    ]
}

fn bottle() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.4, 0.0], [0.25, 0.4, 0.25], OWN).in_part(&["body"]),
        piece(Cone, [0.0, 0.95, 0.0], [0.25, 0.15, 0.25], OWN).in_part(&["body"]),
        piece(Cylinder, [0.0, 1.0, 0.0], [0.09, 0.2, 0.09], DARKER).in_part(&["neck"]),
    ]
}

pub fn lamp() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.05, 0.0], [0.32, 0.05, 0.32], DARKER).in_part(&["foot"]),
        piece(Cylinder, [0.0, 0.5, 0.0], [0.06, 0.45, 0.06], BRASS).in_part(&["pole"]),
        piece(Cone, [0.0, 0.98, 0.0], [0.42, 0.3, 0.42], OWN).in_part(&["shade"]),
    ]
}

fn bowl() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.06, 0.0], [0.25, 0.06, 0.25], DARKER).in_part(&["foot"]),
        piece(Ball, [0.0, 0.3, 0.0], [0.5, 0.22, 0.5], OWN).in_part(&["basin"]),
    ]
}

fn candle() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.08, 0.0], [0.35, 0.08, 0.35], BRASS).in_part(&["holder"]),
        piece(Cylinder, [0.0, 0.55, 0.0], [0.16, 0.42, 0.16], OWN).in_part(&["wax"]),
        piece(
            Ball,
            [0.0, 1.06, 0.0],
            [0.07, 0.14, 0.07],
            Look::Fixed(Vec3::new(1.0, 0.75, 0.2)),
        )
        .in_part(&["flame"]),
    ]
}

fn crate_box() -> Vec<Piece> {
    vec![piece(Block, [0.0, 0.38, 0.0], [0.45, 0.38, 0.38], OWN)]
}

fn apple() -> Vec<Piece> {
    vec![
        piece(Ball, [0.0, 0.4, 0.0], [0.42, 0.4, 0.42], OWN).in_part(&["flesh"]),
        piece(Cylinder, [0.0, 0.86, 0.0], [0.04, 0.14, 0.04], WOOD)
            .in_part(&["stem"])
            .tilted(0.2, 0.0),
        piece(Ball, [0.16, 0.92, 0.0], [0.18, 0.03, 0.09], LEAF)
            .in_part(&["leaf"])
            .tilted(0.3, 0.0),
    ]
}

fn vase() -> Vec<Piece> {
    vec![
        piece(Ball, [0.0, 0.38, 0.0], [0.35, 0.38, 0.35], OWN).in_part(&["belly"]),
        piece(Cylinder, [0.0, 0.85, 0.0], [0.13, 0.2, 0.13], DARKER).in_part(&["neck"]),
    ]
}

fn tower() -> Vec<Piece> {
    vec![
        piece(Block, [0.0, 0.2, 0.0], [0.4, 0.2, 0.4], OWN).in_part(&["base"]),
        piece(Block, [0.0, 0.55, 0.0], [0.28, 0.15, 0.28], DARKER).in_part(&["middle"]),
        piece(Cone, [0.0, 0.95, 0.0], [0.28, 0.25, 0.28], OWN).in_part(&["roof"]),
    ]
}

fn hat() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.05, 0.0], [0.55, 0.05, 0.55], DARKER).in_part(&["brim"]),
        piece(Cylinder, [0.0, 0.35, 0.0], [0.3, 0.3, 0.3], OWN).in_part(&["crown"]),
    ]
}

/// A cart whose wheels have hubs: three levels.
pub fn cart() -> Vec<Piece> {
    let mut pieces = vec![
        piece(Block, [0.0, 0.55, 0.0], [0.75, 0.22, 0.4], OWN).in_part(&["body"]),
        piece(Block, [0.3, 0.95, 0.0], [0.3, 0.2, 0.3], DARKER).in_part(&["cabin"]),
    ];
    for (name, x, z) in [
        ("front left", 0.5, 0.45),
        ("front right", 0.5, -0.45),
        ("rear left", -0.5, 0.45),
        ("rear right", -0.5, -0.45),
    ] {
        let (wheel, hub) = (format!("{name} wheel"), format!("{name} hub"));
        let across = std::f32::consts::FRAC_PI_2;
        let tyre = Look::Fixed(Vec3::new(0.16, 0.16, 0.18));
        pieces.push(
            piece(Cylinder, [x, 0.28, z], [0.28, 0.06, 0.28], tyre)
                .in_part(&[&wheel])
                .tilted(0.0, across),
        );
        pieces.push(
            piece(Cylinder, [x, 0.28, z], [0.14, 0.085, 0.14], BRASS)
                .in_part(&[&wheel, &hub])
                .tilted(0.0, across),
        );
    }
    pieces
}

/// A cabinet whose drawers have knobs: three levels.
pub fn cabinet() -> Vec<Piece> {
    let mut pieces =
        vec![piece(Block, [0.0, 0.65, 0.0], [0.5, 0.65, 0.35], OWN).in_part(&["frame"])];
    for (name, y) in [("lower", 0.25), ("middle", 0.65), ("upper", 1.05)] {
        let (drawer, knob) = (format!("{name} drawer"), format!("{name} knob"));
        pieces.push(piece(Block, [0.0, y, 0.37], [0.42, 0.16, 0.04], CREAM).in_part(&[&drawer]));
        pieces.push(piece(Ball, [0.0, y, 0.44], [0.09; 3], DARKER).in_part(&[&drawer, &knob]));
    }
    pieces
}

/// A cup on a saucer: every solid belongs to one of the two parts.
pub fn cup_and_saucer() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.05, 0.0], [0.62, 0.05, 0.62], CREAM).in_part(&["saucer"]),
        piece(Cylinder, [0.0, 0.42, 0.0], [0.34, 0.32, 0.34], OWN).in_part(&["cup"]),
        piece(Block, [0.44, 0.42, 0.0], [0.12, 0.2, 0.06], OWN).in_part(&["cup"]),
    ]
}

/// A chest with a drawer as its only part.
pub fn chest() -> Vec<Piece> {
    vec![
        piece(Block, [0.0, 0.45, 0.0], [0.6, 0.45, 0.4], OWN),
        piece(Block, [0.0, 0.5, 0.42], [0.45, 0.25, 0.04], CREAM).in_part(&["drawer"]),
    ]
}

/// A bottle with a label around it.
pub fn labelled_bottle() -> Vec<Piece> {
    vec![
        piece(Cylinder, [0.0, 0.5, 0.0], [0.32, 0.5, 0.32], OWN),
        piece(Cylinder, [0.0, 1.12, 0.0], [0.13, 0.2, 0.13], OWN),
        piece(Cylinder, [0.0, 0.5, 0.0], [0.33, 0.24, 0.33], CREAM).in_part(&["label"]),
    ]
}

/// The edges of a cube as twelve thin rods.
pub fn wire_frame() -> Vec<Piece> {
    let (r, thin) = (0.5, 0.014);
    let mut pieces = Vec::new();
    for (a, b) in [(-r, -r), (-r, r), (r, -r), (r, r)] {
        pieces.push(piece(Block, [0.0, r + a, b], [r, thin, thin], OWN));
        pieces.push(piece(Block, [a, r, b], [thin, r, thin], OWN));
        pieces.push(piece(Block, [a, r + b, 0.0], [thin, thin, r], OWN));
    }
    pieces
}

/// A wheel with thin spokes.
pub fn spoked_wheel() -> Vec<Piece> {
    let (count, radius) = (14, 0.5);
    let mut pieces = vec![piece(Ball, [0.0, 0.55, 0.0], [0.07; 3], BRASS)];
    for k in 0..count {
        let angle = std::f32::consts::TAU * k as f32 / count as f32;
        let (s, c) = angle.sin_cos();
        pieces.push(
            piece(
                Block,
                [0.5 * radius * c, 0.55 + 0.5 * radius * s, 0.0],
                [0.5 * radius, 0.01, 0.01],
                OWN,
            )
            .tilted(angle, 0.0),
        );
        let chord = radius * (std::f32::consts::PI / count as f32).tan() * 1.05;
        pieces.push(
            piece(
                Block,
                [radius * c, 0.55 + radius * s, 0.0],
                [0.03, chord, 0.03],
                DARKER,
            )
            .tilted(angle, 0.0),
        );
    }
    pieces
}

/// A pot with thin stems and leaves.
pub fn plant() -> Vec<Piece> {
    let mut pieces = vec![piece(Cylinder, [0.0, 0.18, 0.0], [0.25, 0.18, 0.25], OWN)];
    for k in 0..9 {
        let angle = 2.4 * k as f32;
        let lean = 0.12 + 0.05 * k as f32;
        let (x, z) = (lean * angle.cos(), lean * angle.sin());
        pieces.push(
            piece(
                Cylinder,
                [0.5 * x, 0.65, 0.5 * z],
                [0.012, 0.32, 0.012],
                LEAF,
            )
            .tilted(-0.8 * x, 0.8 * z),
        );
        pieces.push(
            piece(
                Ball,
                [x, 0.95 + 0.03 * k as f32, z],
                [0.16, 0.012, 0.07],
                LEAF,
            )
            .tilted(0.5 * angle.cos(), 0.5 * angle.sin()),
        );
    }
    pieces
}

/// A standing slab on a wooden foot.
pub fn slab() -> Vec<Piece> {
    vec![
        piece(Block, [0.0, 0.06, 0.0], [0.55, 0.06, 0.2], WOOD),
        piece(Block, [0.0, 0.75, 0.0], [0.5, 0.65, 0.03], OWN),
    ]
}
