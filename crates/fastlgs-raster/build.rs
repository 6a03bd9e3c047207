//! Puts the WGSL passes together, validates every permutation with naga, and writes `shaders.rs`: for each pass its
//! sources and the kinds of its bindings.
//!
//! `#import NAME` takes in `shared/NAME.wgsl` once; `#ifdef FLAG`/`#else`/`#endif` choose by permutation; the lines between
//! `#each K 8` and `#end` are repeated 8 times, `$K` being the number of the repetition. `#each Q` repeats for the pixel
//! quads of an invocation, with `$C` as the quad's column.

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
        // Shapes and channels of which the pass knows nothing would only repeat a source.
        let mut sources: Vec<(Vec<&str>, String)> = Vec::new();
        let choices = SHAPES.iter().flat_map(|s| CHANNELS.iter().flat_map(move |c| HARMONICS.iter().map(move |h| [*s, *c, *h].concat())));
        for flags in choices {
            let mut used = BTreeSet::new();
            let source = assemble(root, &path, &flags, &mut used);
            let flags: Vec<&str> = flags.into_iter().filter(|f| used.contains(*f)).collect();
            if !sources.iter().any(|(known, _)| *known == flags) {
                sources.push((flags, source));
            }
        }
        let bindings = validate(&name, &sources[0].1);
        for (_, source) in &sources[1..] {
            assert_eq!(bindings, validate(&name, source), "{name}: all permutations bind the same");
        }
        let sources: Vec<String> = sources.iter().map(|(flags, source)| format!("(&{flags:?}, {source:?})")).collect();
        writeln!(
            out,
            "/// `shaders/{name}.wgsl`\npub static {}: Shader = Shader {{ name: {name:?}, sources: &[{}], bindings: &[{}] }};",
            name.to_uppercase(),
            sources.join(", "),
            bindings.join(", ")
        )
        .expect("writing to a string");
    }
    fs::write(Path::new(&env::var("OUT_DIR").expect("cargo sets OUT_DIR")).join("shaders.rs"), out).expect("writable OUT_DIR");
}

/// Flags of `Shape` in `src/gpu.rs`.
const SHAPES: [&[&str]; 3] = [&[], &["SUBGROUPS"], &["WIDE"]];
/// Flags of `Channels` in `src/pass.rs`.
const CHANNELS: [&[&str]; 4] =
    [&["WITH_COLOR"], &["WITH_FEATURE"], &["WITH_COLOR", "WITH_FEATURE"], &["WITH_COLOR", "WITH_FEATURE", "FEATURE_MOVES"]];

/// Whether colour depends on the view: a software rasteriser does not skip branches, even if all invocations would.
const HARMONICS: [&[&str]; 2] = [&[], &["WITH_SH"]];

/// The text of a pass; `used` collects the flags that it asks for.
fn assemble(root: &Path, path: &Path, flags: &[&str], used: &mut BTreeSet<String>) -> String {
    let mut seen = BTreeSet::new();
    let mut out = String::new();
    expand(root, path, flags, used, &mut seen, &mut out);
    out
}

fn expand(root: &Path, path: &Path, flags: &[&str], used: &mut BTreeSet<String>, seen: &mut BTreeSet<String>, out: &mut String) {
    let text = fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    // An 8x8 tile has 16 quads; it is one invocation's, or shared by eight.
    let (quads, columns) = if flags.contains(&"WIDE") { (16, 2) } else { (2, 1) };
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
                    expand(root, &root.join("shared").join(format!("{name}.wgsl")), flags, used, seen, out);
                }
            }
            ["#each", "Q"] => {
                used.insert("WIDE".to_owned());
                repeated = Some(("$Q", quads, String::new()));
            }
            ["#each", "K", count] => repeated = Some(("$K", count.parse().expect("a number of repetitions"), String::new())),
            ["#end"] => {
                let (name, count, lines) = repeated.take().expect("#end follows #each");
                for k in 0..count {
                    out.push_str(&lines.replace(name, &k.to_string()).replace("$C", &(k % columns).to_string()));
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
