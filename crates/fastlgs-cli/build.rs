//! Validates the viewer's shaders, and translates the one that draws, `web/splat.wgsl`, for browsers without WebGPU: naga writes the
//! GLSL of WebGL2, so that both draw by the same source and a broken shader fails the build.

use naga::Module;
use naga::back::glsl;
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use std::path::Path;
use std::{env, fs};

const SOURCE: &str = "web/splat.wgsl";

fn main() {
    valid("web/present.wgsl");
    let (module, info) = valid(SOURCE);
    let options = glsl::Options {
        version: glsl::Version::Embedded { version: 300, is_webgl: true },
        writer_flags: glsl::WriterFlags::empty(),
        ..Default::default()
    };
    let out = env::var("OUT_DIR").expect("cargo sets OUT_DIR");
    for (stage, entry) in [(naga::ShaderStage::Vertex, "corner"), (naga::ShaderStage::Fragment, "pixel")] {
        let pipeline = glsl::PipelineOptions { shader_stage: stage, entry_point: entry.to_owned(), multiview: None };
        let mut text = String::new();
        let mut writer = glsl::Writer::new(&mut text, &module, &info, &options, &pipeline, Default::default())
            .unwrap_or_else(|e| panic!("{SOURCE}, {entry}: {e}"));
        writer.write().unwrap_or_else(|e| panic!("{SOURCE}, {entry}: {e}"));
        fs::write(Path::new(&out).join(format!("{entry}.glsl")), text).expect("writable OUT_DIR");
    }
}

fn valid(path: &str) -> (Module, ModuleInfo) {
    println!("cargo::rerun-if-changed={path}");
    let source = fs::read_to_string(path).expect("web/ is in the crate");
    let module = naga::front::wgsl::parse_str(&source).unwrap_or_else(|e| panic!("{path}:\n{}", e.emit_to_string(&source)));
    let info = Validator::new(ValidationFlags::all(), Capabilities::empty()).validate(&module);
    let info = info.unwrap_or_else(|e| panic!("{path}:\n{}", e.emit_to_string(&source)));
    (module, info)
}
