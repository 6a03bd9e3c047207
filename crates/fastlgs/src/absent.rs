//! Names of absent objects, which measure false alarms.

/// Absent names for scenes of the project. Callers skip a name that occurs in a label.
pub(crate) const ABSENT: [&str; 40] = [
    "elephant",
    "airplane",
    "pizza",
    "submarine",
    "toothbrush",
    "volcano",
    "guitar",
    "penguin",
    "traffic light",
    "banana",
    "helicopter",
    "snowman",
    "tractor",
    "sushi",
    "lighthouse",
    "giraffe",
    "microwave oven",
    "jellyfish",
    "castle",
    "sailboat",
    "hamburger",
    "parachute",
    "cactus",
    "ice cream",
    "fire engine",
    "octopus",
    "washing machine",
    "canoe",
    "trombone",
    "strawberry",
    "tank",
    "rocket",
    "goldfish",
    "bulldozer",
    "sunglasses",
    "stethoscope",
    "ambulance",
    "zebra",
    "broccoli",
    "umbrella",
];

/// Words that are put before absent names. The colour of a present object must not make an absent
/// name match.
pub(crate) const COLORS: [&str; 8] = [
    "red", "blue", "green", "purple", "white", "black", "brown", "wooden",
];
