//! Puts the WGSL passes together (`#import NAME`, `#ifdef FLAG`/`#else`/`#endif`), validates every permutation with
//! naga, and writes `shaders.rs`: for each pass its sources and the kinds of its bindings.

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
        let plain = assemble(root, &path, false);
        let subgroups = assemble(root, &path, true);
        let bindings = validate(&name, &plain);
        assert_eq!(bindings, validate(&name, &subgroups), "{name}: both permutations bind the same");
        writeln!(
            out,
            "/// `shaders/{name}.wgsl`\npub static {}: Shader = Shader {{ name: {name:?}, plain: {plain:?}, subgroups: {subgroups:?}, bindings: &[{}] }};",
            name.to_uppercase(),
            bindings.join(", ")
        )
        .expect("writing to a string");
    }
    fs::write(Path::new(&env::var("OUT_DIR").expect("cargo sets OUT_DIR")).join("shaders.rs"), out).expect("writable OUT_DIR");
}

fn assemble(root: &Path, path: &Path, subgroups: bool) -> String {
    let mut seen = BTreeSet::new();
    let mut out = String::new();
    expand(root, path, subgroups, &mut seen, &mut out);
    out
}

fn expand(root: &Path, path: &Path, subgroups: bool, seen: &mut BTreeSet<String>, out: &mut String) {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut active = vec![true];
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["#ifdef", "SUBGROUPS"] => active.push(subgroups),
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
                    expand(root, &root.join("shared").join(format!("{name}.wgsl")), subgroups, seen, out);
                }
            }
            _ => {
                out.push_str(line);
                out.push('\n');
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
