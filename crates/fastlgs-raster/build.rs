//! Assembles and validates the WGSL passes, and writes `shaders.rs`.
//!
//! naga validates every permutation and translates it for Vulkan, Metal and Direct3D 12. For each
//! pass, `shaders.rs` holds a type with its sources, its uniform, and its buffers by name.
//!
//! The shaders are WGSL with these directives, each alone on its line (spaces may precede the `#`):
//!
//! * `#import NAME`: the text of `shared/NAME.wgsl`, inserted at its first import only;
//! * `#ifdef FLAG` ... `#else` ... `#endif`: conditional text. The flags are `WITH_COLOR`,
//!   `WITH_FEATURE` and `FEATURE_MOVES` (from `Channels`), `WITH_SH` (colour depends on the view)
//!   and `WIDE` (from `Shape`);
//! * `#each K 8` ... `#end`: repeats the lines 8 times, with `$K` replaced by 0 to 7. It unrolls
//!   loops whose values must stay in registers;
//! * `#each Q` ... `#end`: repeats the lines for each quad (four pixels of a row) of an invocation.
//!   `$Q` is the number of the quad and `$C` its column of quads. With `WIDE`, an invocation owns
//!   an 8x8 tile: 16 quads in 2 columns. Otherwise it owns one quad.
//!
//! Blocks of `#ifdef` may be nested, those of `#each` may not. `shared/lane.wgsl` defines which
//! pixels the quads of a lane cover.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;
use std::{env, fs};

fn main() {
    let root = Path::new("../../shaders");
    println!("cargo::rerun-if-changed={}", root.display());
    let mut passes: Vec<_> = fs::read_dir(root)
        .expect("shaders/ is beside crates/")
        .map(|entry| entry.expect("readable shaders/").path())
        .filter(|path| path.extension().is_some_and(|e| e == "wgsl"))
        .collect();
    passes.sort();
    let mut out = String::new();
    for path in passes {
        println!("cargo::rerun-if-changed={}", path.display());
        let name = path
            .file_stem()
            .expect("a file")
            .to_str()
            .expect("UTF-8")
            .to_owned();
        // Skip permutations that differ only in flags that the pass does not use.
        let mut sources: Vec<(Vec<&str>, String)> = Vec::new();
        let choices = SHAPES.iter().flat_map(|s| {
            CHANNELS
                .iter()
                .flat_map(move |c| HARMONICS.iter().map(move |h| [*s, *c, *h].concat()))
        });
        for flags in choices {
            let mut used = BTreeSet::new();
            let source = assemble(root, &path, &flags, &mut used);
            let flags: Vec<&str> = flags.into_iter().filter(|f| used.contains(*f)).collect();
            if !sources.iter().any(|(known, _)| *known == flags) {
                sources.push((flags, source));
            }
        }
        let bound = validate(&name, &sources[0].1);
        for (_, source) in &sources[1..] {
            assert_eq!(
                bound,
                validate(&name, source),
                "{name}: all permutations must have the same bindings"
            );
        }
        out.push_str(&rust_of(&name, &sources, &bound));
    }
    fs::write(
        Path::new(&env::var("OUT_DIR").expect("cargo sets OUT_DIR")).join("shaders.rs"),
        out,
    )
    .expect("writable OUT_DIR");
}

/// Bytes of workgroup memory that every WebGPU adapter grants.
const WORKGROUP_BYTES: u32 = 16_384;

/// Flags of `Shape` in `src/shape.rs`.
const SHAPES: [&[&str]; 2] = [&[], &["WIDE"]];
/// Flags of `Channels` in `src/channels.rs`.
const CHANNELS: [&[&str]; 4] = [
    &["WITH_COLOR"],
    &["WITH_FEATURE"],
    &["WITH_COLOR", "WITH_FEATURE"],
    &["WITH_COLOR", "WITH_FEATURE", "FEATURE_MOVES"],
];

/// Permutations without and with view-dependent colour. They are separate because software adapters
/// do not skip branches, even if all invocations would.
const HARMONICS: [&[&str]; 2] = [&[], &["WITH_SH"]];

/// Returns the source of a pass, and adds the flags that it uses to `used`.
fn assemble(root: &Path, path: &Path, flags: &[&str], used: &mut BTreeSet<String>) -> String {
    let mut seen = BTreeSet::new();
    let mut out = String::new();
    expand(root, path, flags, used, &mut seen, &mut out);
    out
}

fn expand(
    root: &Path,
    path: &Path,
    flags: &[&str],
    used: &mut BTreeSet<String>,
    seen: &mut BTreeSet<String>,
    out: &mut String,
) {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    // An 8x8 tile has 16 quads. With WIDE, one invocation owns all of them. Otherwise each of 16
    // invocations owns one.
    let (quads, columns) = if flags.contains(&"WIDE") {
        (16, 2)
    } else {
        (1, 1)
    };
    let mut active = vec![true];
    let mut repeated: Option<(&str, usize, String)> = None;
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["#ifdef", flag] => {
                used.insert((*flag).to_owned());
                active.push(flags.contains(flag));
            }
            ["#else"] => {
                let last = active.last_mut().expect("#else follows #ifdef");
                *last = !*last;
            }
            ["#endif"] => {
                active.pop();
            }
            _ if !active.iter().all(|a| *a) => {}
            ["#import", name] => {
                if seen.insert((*name).to_owned()) {
                    expand(
                        root,
                        &root.join("shared").join(format!("{name}.wgsl")),
                        flags,
                        used,
                        seen,
                        out,
                    );
                }
            }
            ["#each", "Q"] => {
                used.insert("WIDE".to_owned());
                repeated = Some(("$Q", quads, String::new()));
            }
            ["#each", "K", count] => {
                repeated = Some((
                    "$K",
                    count.parse().expect("a number of repetitions"),
                    String::new(),
                ))
            }
            ["#end"] => {
                let (name, count, lines) = repeated.take().expect("#end follows #each");
                for k in 0..count {
                    out.push_str(
                        &lines
                            .replace(name, &k.to_string())
                            .replace("$C", &(k % columns).to_string()),
                    );
                }
            }
            _ => {
                let target = repeated.as_mut().map_or(&mut *out, |r| &mut r.2);
                target.push_str(line);
                target.push('\n');
            }
        }
    }
}

/// A variable that a shader binds.
#[derive(Debug, PartialEq)]
struct Bound {
    binding: u32,
    /// Its name in the shader.
    name: String,
    kind: &'static str,
    /// Name and size in bytes of its type, if the type is a structure.
    structure: Option<(String, u32)>,
}

/// Parses and validates a source. Returns its bound variables in the order of their bindings.
fn validate(name: &str, source: &str) -> Vec<Bound> {
    let module = naga::front::wgsl::parse_str(source)
        .unwrap_or_else(|e| panic!("shaders/{name}.wgsl:\n{}", e.emit_to_string(source)));
    let info = naga::valid::Validator::new(
        naga::valid::ValidationFlags::all(),
        naga::valid::Capabilities::all(),
    )
    .validate(&module)
    .unwrap_or_else(|e| panic!("shaders/{name}.wgsl:\n{}", e.emit_to_string(source)));
    translate(name, &module, &info);
    let shared = module
        .global_variables
        .iter()
        .filter(|(_, v)| v.space == naga::AddressSpace::WorkGroup);
    let bytes: u32 = shared
        .map(|(_, v)| {
            module.types[v.ty]
                .inner
                .size(module.to_ctx())
                .next_multiple_of(16)
        })
        .sum();
    assert!(
        bytes <= WORKGROUP_BYTES,
        "shaders/{name}.wgsl needs {bytes} bytes of workgroup memory, which not every adapter grants"
    );
    let mut bound: Vec<Bound> = module
        .global_variables
        .iter()
        .filter_map(|(_, variable)| {
            let kind = match variable.space {
                naga::AddressSpace::Uniform => "Binding::Uniform",
                naga::AddressSpace::Storage { access }
                    if access.contains(naga::StorageAccess::STORE) =>
                {
                    "Binding::ReadWrite"
                }
                naga::AddressSpace::Storage { .. } => "Binding::Read",
                _ => return None,
            };
            let own = &module.types[variable.ty];
            Some(Bound {
                binding: variable.binding.as_ref().expect("a binding number").binding,
                name: variable.name.clone().expect("a name"),
                kind,
                structure: own
                    .name
                    .clone()
                    .map(|structure| (structure, own.inner.size(module.to_ctx()))),
            })
        })
        .collect();
    bound.sort_by_key(|b| b.binding);
    assert!(
        bound.iter().enumerate().all(|(k, b)| b.binding == k as u32),
        "{name}: bindings must be 0, 1, 2, ..."
    );
    assert_eq!(
        bound[0].kind, "Binding::Uniform",
        "{name}: binding 0 must be the uniform"
    );
    bound
}

/// Translates the module for all platforms. A shader that one of them cannot express then fails
/// this build, not a later one on that platform.
fn translate(name: &str, module: &naga::Module, info: &naga::valid::ModuleInfo) {
    use naga::back::{hlsl, msl, spv};
    let failed = |to: &str, e: &dyn std::fmt::Display| -> ! {
        panic!("shaders/{name}.wgsl cannot be translated to {to}: {e}")
    };
    let options = spv::Options {
        lang_version: (1, 3),
        ..spv::Options::default()
    };
    spv::write_vec(module, info, &options, None).unwrap_or_else(|e| failed("SPIR-V", &e));

    let options = msl::Options {
        lang_version: (2, 4),
        ..msl::Options::default()
    };
    let metal = msl::write_string(module, info, &options, &msl::PipelineOptions::default())
        .unwrap_or_else(|e| failed("Metal", &e));
    if let Some(e) = metal
        .1
        .entry_point_names
        .iter()
        .find_map(|entry| entry.as_ref().err())
    {
        failed("Metal", e);
    }

    let options = hlsl::Options {
        shader_model: hlsl::ShaderModel::V6_0,
        ..hlsl::Options::default()
    };
    let (mut out, pipeline) = (String::new(), hlsl::PipelineOptions::default());
    let direct3d = hlsl::Writer::new(&mut out, &options, &pipeline)
        .write(module, info, None)
        .unwrap_or_else(|e| failed("HLSL", &e));
    if let Some(e) = direct3d
        .entry_point_names
        .iter()
        .find_map(|entry| entry.as_ref().err())
    {
        failed("HLSL", e);
    }
}

/// Generates the Rust code of a pass: a type with its shader, and its buffers by name.
fn rust_of(name: &str, sources: &[(Vec<&str>, String)], bound: &[Bound]) -> String {
    let title: String = name
        .split('_')
        .map(|word| format!("{}{}", word[..1].to_uppercase(), &word[1..]))
        .collect();
    let (uniform, bytes) = bound[0]
        .structure
        .as_ref()
        .expect("a uniform is a structure");
    let storages: Vec<&str> = bound[1..].iter().map(|b| b.name.as_str()).collect();
    let fields: String = storages
        .iter()
        .map(|s| format!("    pub {s}: &'a wgpu::Buffer,\n"))
        .collect();
    let in_order: String = storages.iter().map(|s| format!("buffers.{s}, ")).collect();
    let kinds: Vec<&str> = bound.iter().map(|b| b.kind).collect();
    let sources: Vec<String> = sources
        .iter()
        .map(|(flags, source)| format!("(&{flags:?}, {source:?})"))
        .collect();
    let mut out = String::new();
    write!(
        out,
        "/// `shaders/{name}.wgsl`
pub enum {title} {{}}
/// Buffers of `shaders/{name}.wgsl`, with the names in the shader.
pub struct {title}Buffers<'a> {{
{fields}}}
impl Kernel for {title} {{
    const SHADER: &'static Shader = &Shader {{ name: {name:?}, sources: &[{sources}], bindings: &[{kinds}] }};
    type Uniform = crate::view::{uniform};
    type Buffers<'a> = {title}Buffers<'a>;
    fn in_order<'a>(buffers: &Self::Buffers<'a>) -> Vec<&'a wgpu::Buffer> {{
        vec![{in_order}]
    }}
}}
const _: () = assert!(size_of::<crate::view::{uniform}>() == {bytes}, \"{uniform} has a different size in shaders/{name}.wgsl\");
const _: () = assert!({bytes} <= crate::gpu::UNIFORM_SLOT, \"{uniform} needs larger slots\");
",
        sources = sources.join(", "),
        kinds = kinds.join(", "),
    )
    .expect("writing to a string");
    out
}
