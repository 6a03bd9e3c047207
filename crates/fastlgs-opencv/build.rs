//! Compiles the C++ wrappers and links the system's OpenCV.

fn main() {
    println!("cargo::rerun-if-changed=src");
    let mut build = cc::Build::new();
    build
        .cpp(true)
        .std("c++14")
        .warnings(false)
        .files(["src/sift.cpp", "src/inpaint.cpp"]);
    // Debian's packages of single modules have no pkg-config file: use their usual header folder.
    match pkg_config::Config::new()
        .cargo_metadata(false)
        .probe("opencv4")
    {
        Ok(library) => {
            build.includes(&library.include_paths);
            library
                .link_paths
                .iter()
                .for_each(|path| println!("cargo::rustc-link-search=native={}", path.display()));
        }
        Err(_) => drop(build.include("/usr/include/opencv4")),
    }
    if let Err(error) = build.try_compile("fastlgs_opencv") {
        let hint = "install OpenCV 4.4 or newer (on Debian: libopencv-features2d-dev, libopencv-photo-dev), or build without the feature 'opencv'";
        println!("cargo::error={error}; {hint}");
        return;
    }
    for module in ["features2d", "photo", "core"] {
        println!("cargo::rustc-link-lib=opencv_{module}");
    }
}
