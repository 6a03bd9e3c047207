//! Puts the WGSL passes together, validates every permutation with naga, and writes `shaders.rs`: for each pass its
//! sources and the kinds of its bindings.
//!
//! `#import NAME` takes in `shared/NAME.wgsl` once; `#ifdef FLAG`/`#else`/`#endif` choose by permutation; the lines between
//! `#each Q` and `#end` are repeated for the pixel quads of an invocation, `$Q` being the quad's number.

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
        let name = path.file_stem().expect("a file").to_str().expect("UTF-8").to_owned();
        let sources = PERMUTATIONS.map(|flags| assemble(root, &path, flags));
        let bindings = validate(&name, &sources[0]);
        for source in &sources[1..] {
            assert_eq!(bindings, validate(&name, source), "{name}: all permutations bind the same");
        }
        writeln!(
            out,
            "/// `shaders/{name}.wgsl`\npub static {}: Shader = Shader {{ name: {name:?}, sources: {sources:?}, bindings: &[{}] }};",
            name.to_uppercase(),
            bindings.join(", ")
        )
        .expect("writing to a string");
    }
    fs::write(Path::new(&env::var("OUT_DIR").expect("cargo sets OUT_DIR")).join("shaders.rs"), out).expect("writable OUT_DIR");
}

/// Flags of the permutations, in the order of `Shape` in `src/gpu.rs`.
const PERMUTATIONS: [&[&str]; 3] = [&[], &["SUBGROUPS"], &["WIDE"]];

fn assemble(root: &Path, path: &Path, flags: &[&str]) -> String {
    let mut seen = BTreeSet::new();
    let mut out = String::new();
    expand(root, path, flags, &mut seen, &mut out);
    out
}

fn expand(root: &Path, path: &Path, flags: &[&str], seen: &mut BTreeSet<String>, out: &mut String) {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    // An 8x8 tile has 16 quads; it is one invocation's, or shared by eight.
    let quads = if flags.contains(&"WIDE") { 16 } else { 2 };
    let mut active = vec![true];
    let mut repeated: Option<String> = None;
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["#ifdef", flag] => active.push(flags.contains(flag)),
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
                    expand(root, &root.join("shared").join(format!("{name}.wgsl")), flags, seen, out);
                }
            }
            ["#each", "Q"] => repeated = Some(String::new()),
            ["#end"] => {
                let lines = repeated.take().expect("#end follows #each");
                (0..quads).for_each(|q| out.push_str(&lines.replace("$Q", &q.to_string())));
            }
            _ => {
                let target = repeated.as_mut().unwrap_or(out);
                target.push_str(line);
                target.push('\n');
            }
        }
    }
}

/// Parses and validates; returns the kind of each binding in order.
fn validate(name: &str, source: &str) -> Vec<String> {
    let module = naga::front::wgsl::parse_str(source).unwrap_or_else(|e| panic!("shaders/{name}.wgsl:\n{}", e.emit_to_string(source)));
    naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::all())
        .subgroup_stages(naga::valid::ShaderStages::COMPUTE)
        .subgroup_operations(naga::valid::SubgroupOperationSet::all())
        .validate(&module)
        .unwrap_or_else(|e| panic!("shaders/{name}.wgsl:\n{}", e.emit_to_string(source)));
    let mut bindings: Vec<(u32, String)> = module
        .global_variables
        .iter()
        .filter_map(|(_, variable)| {
            let kind = match variable.space {
                naga::AddressSpace::Uniform => "Binding::Uniform",
                naga::AddressSpace::Storage { access } if access.contains(naga::StorageAccess::STORE) => "Binding::ReadWrite",
                naga::AddressSpace::Storage { .. } => "Binding::Read",
                _ => return None,
            };
            Some((variable.binding.as_ref().expect("a binding number").binding, kind.to_owned()))
        })
        .collect();
    bindings.sort();
    bindings.into_iter().map(|b| b.1).collect()
}
