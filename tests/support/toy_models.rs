//! Stand-ins for SAM and CLIP, with the signatures of real exports and known answers.

use super::onnx::{Attribute, Graph, Kind};
use std::path::Path;

/// Exporter whose signature the model has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SamExport {
    /// Official export, with `point_coords`. Accepts any number of prompts (`batched`) or one.
    Official { batched: bool },
    /// EfficientSAM, with `batched_point_coords`.
    Efficient,
    /// transformers, with `input_points`.
    Transformers,
    /// EdgeSAM: only the points of the official decoder, and other output names.
    Edge,
    /// SAM 2: a stretched picture, and embeddings at three resolutions.
    Second,
    /// Official export with one mask per prompt.
    Single,
    /// Official export in 16-bit floats.
    Half,
}

impl SamExport {
    /// Returns whether points are named `point_coords`.
    fn official(self) -> bool {
        !matches!(self, Self::Efficient | Self::Transformers)
    }
}

/// Width and height of embeddings and masks, in pixels.
const EMBEDDING_SIDE: i64 = 256;
/// Squared colour distances, in standard deviations, of the masks for subpart, part and whole. A
/// mask holds the pixels whose distance to the prompted colour is smaller.
pub const COLOUR_TOLERANCES: [f32; 3] = [0.02, 0.4, 1.6];

/// Writes an encoder and a decoder. The embedding is the scaled-down photo. The masks are the
/// pixels of the prompted colour, with three tolerances (`COLOUR_TOLERANCES`).
pub fn sam(export: SamExport, encoder: &Path, decoder: &Path) {
    let mut g = Graph::default();
    let (input, shape) = match export {
        SamExport::Official { .. }
        | SamExport::Edge
        | SamExport::Second
        | SamExport::Single
        | SamExport::Half => ("image", [1, 3, 1024, 1024]),
        SamExport::Efficient => ("batched_images", [-1, 3, -1, -1]),
        SamExport::Transformers => ("pixel_values", [-1, 3, 1024, 1024]),
    };
    let kind = if export == SamExport::Half {
        Kind::Half
    } else {
        Kind::Float
    };
    let cast = |g: &mut Graph, value: &str, to: Kind| {
        if export == SamExport::Half {
            g.op("Cast", &[value], &[Attribute::Int("to", to as i64)])
        } else {
            value.to_owned()
        }
    };
    let photo = g.input(input, kind, &shape);
    let photo = cast(&mut g, &photo, Kind::Float);
    let sizes = g.ints(&[1, 3, EMBEDDING_SIDE, EMBEDDING_SIDE]);
    let small = g.op(
        "Resize",
        &[&photo, "", "", &sizes],
        &[Attribute::Text("mode", "nearest")],
    );
    let small = cast(&mut g, &small, Kind::Half);
    let main = if export == SamExport::Second {
        "image_embed"
    } else {
        "image_embeddings"
    };
    g.output_as(&small, main, kind, &[1, 3, EMBEDDING_SIDE, EMBEDDING_SIDE]);
    if export == SamExport::Second {
        for name in ["high_res_feats_0", "high_res_feats_1"] {
            let same = g.op("Identity", &[&small], &[]);
            g.output(&same, name, &[1, 3, EMBEDDING_SIDE, EMBEDDING_SIDE]);
        }
    }
    if export == SamExport::Transformers {
        let nothing = g.op("Sub", &[&small, &small], &[]);
        g.output(
            &nothing,
            "image_positional_embeddings",
            &[1, 3, EMBEDDING_SIDE, EMBEDDING_SIDE],
        );
    }
    g.save(encoder);

    let mut g = Graph::default();
    let embedding = g.input(main, kind, &[1, 3, EMBEDDING_SIDE, EMBEDDING_SIDE]);
    let embedding = cast(&mut g, &embedding, Kind::Float);
    // Converts points to cells of the embedding.
    let points = match export {
        SamExport::Official { .. }
        | SamExport::Edge
        | SamExport::Second
        | SamExport::Single
        | SamExport::Half => {
            let n = if export == (SamExport::Official { batched: false }) {
                1
            } else {
                -1
            };
            let points = g.input("point_coords", Kind::Float, &[n, -1, 2]);
            g.input("point_labels", Kind::Float, &[n, -1]);
            if export != SamExport::Edge {
                g.input(
                    "mask_input",
                    Kind::Float,
                    &[1, 1, EMBEDDING_SIDE, EMBEDDING_SIDE],
                );
                g.input("has_mask_input", Kind::Float, &[1]);
                g.input("orig_im_size", Kind::Float, &[2]);
            }
            if export == SamExport::Second {
                ["high_res_feats_0", "high_res_feats_1"]
                    .iter()
                    .for_each(|name| {
                        drop(g.input(name, Kind::Float, &[1, 3, EMBEDDING_SIDE, EMBEDDING_SIDE]))
                    });
            }
            let first = g.ints(&[0]);
            let point = g.op("Gather", &[&points, &first], &[Attribute::Int("axis", 1)]);
            let ratio = g.floats(&[1], &[EMBEDDING_SIDE as f32 / 1024.0]);
            g.op("Mul", &[&point, &ratio], &[])
        }
        SamExport::Efficient => {
            let points = g.input("batched_point_coords", Kind::Float, &[1, -1, -1, 2]);
            g.input("batched_point_labels", Kind::Float, &[1, -1, -1]);
            let size = g.input("orig_im_size", Kind::Int, &[2]);
            let order = g.ints(&[1, 0]);
            let size = g.op("Gather", &[&size, &order], &[]);
            let size = g.op(
                "Cast",
                &[&size],
                &[Attribute::Int("to", Kind::Float as i64)],
            );
            let share = g.op("Div", &[&points, &size], &[]);
            let side = g.floats(&[1], &[EMBEDDING_SIDE as f32]);
            g.op("Mul", &[&share, &side], &[])
        }
        SamExport::Transformers => {
            let points = g.input("input_points", Kind::Float, &[1, -1, -1, 2]);
            g.input("input_labels", Kind::Int, &[1, -1, -1]);
            g.input(
                "image_positional_embeddings",
                Kind::Float,
                &[1, 3, EMBEDDING_SIDE, EMBEDDING_SIDE],
            );
            let ratio = g.floats(&[1], &[EMBEDDING_SIDE as f32 / 1024.0]);
            g.op("Mul", &[&points, &ratio], &[])
        }
    };
    let rows = g.ints(&[-1, 2]);
    let points = g.op("Reshape", &[&points, &rows], &[]);
    let cells = g.op("Floor", &[&points], &[]);
    let strides = g.floats(&[2, 1], &[1.0, EMBEDDING_SIDE as f32]);
    let flat = g.op("MatMul", &[&cells, &strides], &[]);
    let one = g.ints(&[-1]);
    let flat = g.op("Reshape", &[&flat, &one], &[]);
    let flat = g.op("Cast", &[&flat], &[Attribute::Int("to", Kind::Int as i64)]);
    let plane = g.ints(&[3, EMBEDDING_SIDE * EMBEDDING_SIDE]);
    let colors = g.op("Reshape", &[&embedding, &plane], &[]);
    let color = g.op("Gather", &[&colors, &flat], &[Attribute::Int("axis", 1)]);
    let color = g.op("Transpose", &[&color], &[Attribute::Ints("perm", &[1, 0])]);
    let column = g.ints(&[-1, 3, 1, 1]);
    let color = g.op("Reshape", &[&color, &column], &[]);
    let difference = g.op("Sub", &[&embedding, &color], &[]);
    let squared = g.op("Mul", &[&difference, &difference], &[]);
    let axis = g.ints(&[1]);
    let distance = g.op(
        "ReduceSum",
        &[&squared, &axis],
        &[Attribute::Int("keepdims", 1)],
    );
    // The official decoder returns four masks. The first one is for prompts of several points, and
    // deliberately wrong here.
    // EfficientSAM takes colours from 0 to 1, the others in standard deviations of about 58 of 255.
    let unit = if export == SamExport::Efficient {
        0.052
    } else {
        1.0
    };
    let mut tolerances = COLOUR_TOLERANCES.map(|r| unit * r).to_vec();
    if matches!(
        export,
        SamExport::Official { .. } | SamExport::Edge | SamExport::Half
    ) {
        tolerances.insert(0, 1e6);
    }
    if export == SamExport::Single {
        tolerances = vec![COLOUR_TOLERANCES[2]];
    }
    let m = tolerances.len() as i64;
    let reach = g.floats(&[1, m, 1, 1], &tolerances);
    let inside = g.op("Sub", &[&reach, &distance], &[]);
    let steep = g.floats(&[1], &[1e4]);
    let logits = g.op("Mul", &[&inside, &steep], &[]);
    // Larger masks score higher. Otherwise, thin masks of blended colours at borders would suppress
    // the areas that they enclose.
    let zero = g.floats(&[1], &[0.0]);
    let positive = g.op("Greater", &[&logits, &zero], &[]);
    let positive = g.op(
        "Cast",
        &[&positive],
        &[Attribute::Int("to", Kind::Float as i64)],
    );
    let share = g.op(
        "ReduceMean",
        &[&positive],
        &[
            Attribute::Ints("axes", &[2, 3]),
            Attribute::Int("keepdims", 0),
        ],
    );
    let range = g.floats(&[1], &[0.05]);
    let bonus = g.op("Mul", &[&share, &range], &[]);
    let least = g.floats(&[1], &[0.9]);
    let scores = g.op("Add", &[&bonus, &least], &[]);
    match export {
        export if export.official() => {
            let (masks, ious) = if export == SamExport::Edge {
                ("masks", "scores")
            } else {
                ("low_res_masks", "iou_predictions")
            };
            g.output(&logits, masks, &[-1, m, EMBEDDING_SIDE, EMBEDDING_SIDE]);
            g.output(&scores, ious, &[-1, m]);
        }
        _ => {
            let (masks, ious) = if export == SamExport::Efficient {
                ("output_masks", "iou_predictions")
            } else {
                ("pred_masks", "iou_scores")
            };
            let shape = g.ints(&[1, -1, m, EMBEDDING_SIDE, EMBEDDING_SIDE]);
            let logits = g.op("Reshape", &[&logits, &shape], &[]);
            let shape = g.ints(&[1, -1, m]);
            let scores = g.op("Reshape", &[&scores, &shape], &[]);
            g.output(&logits, masks, &[1, -1, m, EMBEDDING_SIDE, EMBEDDING_SIDE]);
            g.output(&scores, ious, &[1, -1, m]);
        }
    }
    g.save(decoder);
}

/// Token of each colour's name in CLIP's published vocabulary.
pub const COLOR_TOKENS: [i64; 3] = [736, 1901, 1746];

/// Writes stand-ins for CLIP's towers. The image tower returns the mean red, green and blue minus
/// their average. The text tower returns which of "red", "green" and "blue" occur among the tokens,
/// minus their average. Masked crops are grey around the mask, so colours stay comparable.
pub fn clip(image: &Path, text: &Path, size: i64) {
    image_tower(image, size, &["image_embeds"]);
    let mut g = Graph::default();
    let ids = g.input("input_ids", Kind::Int, &[-1, 77]);
    let axes = g.ints(&[2]);
    let column = g.op("Unsqueeze", &[&ids, &axes], &[]);
    let colors = g.ints(&COLOR_TOKENS);
    let same = g.op("Equal", &[&column, &colors], &[]);
    let same = g.op(
        "Cast",
        &[&same],
        &[Attribute::Int("to", Kind::Float as i64)],
    );
    let found = g.op(
        "ReduceMax",
        &[&same],
        &[Attribute::Ints("axes", &[1]), Attribute::Int("keepdims", 0)],
    );
    let overall = g.op(
        "ReduceMean",
        &[&found],
        &[Attribute::Ints("axes", &[1]), Attribute::Int("keepdims", 1)],
    );
    let centred = g.op("Sub", &[&found, &overall], &[]);
    g.output(&centred, "text_embeds", &[-1, 3]);
    g.save(text);
}

/// Writes the image tower, with the same output under several names.
pub fn image_tower(image: &Path, size: i64, outputs: &[&str]) {
    let mut g = Graph::default();
    let pixels = g.input("pixel_values", Kind::Float, &[-1, 3, size, size]);
    let mean = g.op(
        "ReduceMean",
        &[&pixels],
        &[
            Attribute::Ints("axes", &[2, 3]),
            Attribute::Int("keepdims", 0),
        ],
    );
    let overall = g.op(
        "ReduceMean",
        &[&mean],
        &[Attribute::Ints("axes", &[1]), Attribute::Int("keepdims", 1)],
    );
    for name in outputs {
        let color = g.op("Sub", &[&mean, &overall], &[]);
        g.output(&color, name, &[-1, 3]);
    }
    g.save(image);
}
