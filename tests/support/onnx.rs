//! Writes small ONNX models, so that tests can check whole algorithms with known answers and
//! without downloaded weights.
//!
//! Supports the parts of the format (protobuf) that these models need: nodes, float and integer
//! constants, tensors as inputs and outputs, opset 17.

use std::path::Path;

/// Element type of a tensor. The numbers are those of ONNX.
#[derive(Clone, Copy)]
pub enum Kind {
    /// 32-bit floats.
    Float = 1,
    /// 64-bit integers.
    Int = 7,
    /// 16-bit floats.
    Half = 10,
}

/// An attribute of a node.
pub enum Attribute<'a> {
    /// One integer.
    Int(&'a str, i64),
    /// A list of integers.
    Ints(&'a str, &'a [i64]),
    /// A string.
    Text(&'a str, &'a str),
}

/// A model under construction, as encoded protobuf fields.
#[derive(Default)]
pub struct Graph {
    fields: Vec<u8>,
    inputs: Vec<u8>,
    outputs: Vec<u8>,
    names: usize,
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn number(out: &mut Vec<u8>, field: u64, value: i64) {
    varint(out, field << 3);
    varint(out, value as u64);
}

fn bytes(out: &mut Vec<u8>, field: u64, value: &[u8]) {
    varint(out, field << 3 | 2);
    varint(out, value.len() as u64);
    out.extend(value);
}

fn value_info(name: &str, kind: Kind, shape: &[i64]) -> Vec<u8> {
    let mut dimensions = Vec::new();
    for (k, length) in shape.iter().enumerate() {
        let mut dimension = Vec::new();
        if *length >= 0 {
            number(&mut dimension, 1, *length);
        } else {
            bytes(&mut dimension, 2, format!("{name}_{k}").as_bytes());
        }
        bytes(&mut dimensions, 1, &dimension);
    }
    let (mut tensor, mut type_, mut info) = (Vec::new(), Vec::new(), Vec::new());
    number(&mut tensor, 1, kind as i64);
    bytes(&mut tensor, 2, &dimensions);
    bytes(&mut type_, 1, &tensor);
    bytes(&mut info, 1, name.as_bytes());
    bytes(&mut info, 2, &type_);
    info
}

impl Graph {
    /// Declares an input. Lengths of -1 are dynamic.
    pub fn input(&mut self, name: &str, kind: Kind, shape: &[i64]) -> String {
        bytes(&mut self.inputs, 11, &value_info(name, kind, shape));
        name.to_owned()
    }

    /// Declares a float value as an output with the name `name`.
    pub fn output(&mut self, value: &str, name: &str, shape: &[i64]) {
        self.output_as(value, name, Kind::Float, shape);
    }

    /// Declares a value of the type `kind` as an output with the name `name`.
    pub fn output_as(&mut self, value: &str, name: &str, kind: Kind, shape: &[i64]) {
        self.node("Identity", &[value], &[], name);
        bytes(&mut self.outputs, 12, &value_info(name, kind, shape));
    }

    fn new_name(&mut self) -> String {
        self.names += 1;
        format!("v{}", self.names)
    }

    fn constant(&mut self, kind: Kind, shape: &[i64], raw: &[u8]) -> String {
        let name = self.new_name();
        let mut tensor = Vec::new();
        shape.iter().for_each(|d| number(&mut tensor, 1, *d));
        number(&mut tensor, 2, kind as i64);
        bytes(&mut tensor, 8, name.as_bytes());
        bytes(&mut tensor, 9, raw);
        bytes(&mut self.fields, 5, &tensor);
        name
    }

    /// Adds a float constant and returns its name.
    pub fn floats(&mut self, shape: &[i64], values: &[f32]) -> String {
        self.constant(
            Kind::Float,
            shape,
            &values
                .iter()
                .flat_map(|v| v.to_le_bytes())
                .collect::<Vec<_>>(),
        )
    }

    /// Adds a one-dimensional integer constant and returns its name.
    pub fn ints(&mut self, values: &[i64]) -> String {
        self.constant(
            Kind::Int,
            &[values.len() as i64],
            &values
                .iter()
                .flat_map(|v| v.to_le_bytes())
                .collect::<Vec<_>>(),
        )
    }

    /// Adds a node and returns the name of its result.
    pub fn op(&mut self, kind: &str, inputs: &[&str], attributes: &[Attribute]) -> String {
        let name = self.new_name();
        self.node(kind, inputs, attributes, &name);
        name
    }

    fn node(&mut self, kind: &str, inputs: &[&str], attributes: &[Attribute], output: &str) {
        let mut node = Vec::new();
        inputs
            .iter()
            .for_each(|i| bytes(&mut node, 1, i.as_bytes()));
        bytes(&mut node, 2, output.as_bytes());
        bytes(&mut node, 4, kind.as_bytes());
        for attribute in attributes {
            let mut a = Vec::new();
            match attribute {
                Attribute::Int(name, value) => {
                    bytes(&mut a, 1, name.as_bytes());
                    number(&mut a, 3, *value);
                    number(&mut a, 20, 2);
                }
                Attribute::Ints(name, values) => {
                    bytes(&mut a, 1, name.as_bytes());
                    values.iter().for_each(|v| number(&mut a, 8, *v));
                    number(&mut a, 20, 7);
                }
                Attribute::Text(name, value) => {
                    bytes(&mut a, 1, name.as_bytes());
                    bytes(&mut a, 4, value.as_bytes());
                    number(&mut a, 20, 3);
                }
            }
            bytes(&mut node, 5, &a);
        }
        bytes(&mut self.fields, 1, &node);
    }

    /// Writes the model to a file.
    pub fn save(self, path: &Path) {
        let (mut graph, mut opset, mut model) = (self.fields, Vec::new(), Vec::new());
        bytes(&mut graph, 2, b"test");
        graph.extend(self.inputs);
        graph.extend(self.outputs);
        number(&mut opset, 2, 17);
        number(&mut model, 1, 8);
        bytes(&mut model, 8, &opset);
        bytes(&mut model, 7, &graph);
        std::fs::write(path, model).expect("the model");
    }
}
