//! Validates the viewer's shaders and translates `web/splat.wgsl` to GLSL for browsers without
//! WebGPU.
//!
//! The translator is naga. WebGPU and WebGL2 thus share one source, and an invalid shader fails the
//! build.

use naga::Module;
use naga::back::glsl;
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use std::path::Path;
use std::{env, fs};

const SOURCE: &str = "web/splat.wgsl";
/// Shader files that the rasteriser's passes and the viewer share.
const SHARED: &str = "../../shaders/shared";

fn main() {
    let out = env::var("OUT_DIR").expect("cargo sets OUT_DIR");
    parse_and_validate("web/present.wgsl", &read("web/present.wgsl"));
    let source = resolve_imports();
    let (module, info) = parse_and_validate(SOURCE, &source);
    fs::write(Path::new(&out).join("splat.wgsl"), &source).expect("writable OUT_DIR");
    let options = glsl::Options {
        version: glsl::Version::Embedded {
            version: 300,
            is_webgl: true,
        },
        writer_flags: glsl::WriterFlags::empty(),
        ..Default::default()
    };
    for (stage, entry) in [
        (naga::ShaderStage::Vertex, "corner"),
        (naga::ShaderStage::Fragment, "pixel"),
    ] {
        let pipeline = glsl::PipelineOptions {
            shader_stage: stage,
            entry_point: entry.to_owned(),
            multiview: None,
        };
        let mut text = String::new();
        let mut writer = glsl::Writer::new(
            &mut text,
            &module,
            &info,
            &options,
            &pipeline,
            Default::default(),
        )
        .unwrap_or_else(|e| panic!("{SOURCE}, {entry}: {e}"));
        writer
            .write()
            .unwrap_or_else(|e| panic!("{SOURCE}, {entry}: {e}"));
        fs::write(Path::new(&out).join(format!("{entry}.glsl")), text).expect("writable OUT_DIR");
    }
}

fn read(path: &str) -> String {
    println!("cargo::rerun-if-changed={path}");
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Returns the drawing shader with its imports replaced by the shared files. Imports inside the
/// shared files are removed, so the shader itself must import those files.
fn resolve_imports() -> String {
    let line = |line: &str| match line.strip_prefix("#import ") {
        Some(name) => read(&format!("{SHARED}/{name}.wgsl"))
            .lines()
            .filter(|l| !l.starts_with("#import"))
            .map(|l| format!("{l}\n"))
            .collect(),
        None => format!("{line}\n"),
    };
    read(SOURCE).lines().map(line).collect()
}

fn parse_and_validate(path: &str, source: &str) -> (Module, ModuleInfo) {
    let module = naga::front::wgsl::parse_str(source)
        .unwrap_or_else(|e| panic!("{path}:\n{}", e.emit_to_string(source)));
    let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module);
    let info = info.unwrap_or_else(|e| panic!("{path}:\n{}", e.emit_to_string(source)));
    (module, info)
}
