//! Finds the photos of a folder and matches them with the names in pose files.

use super::{is_photo, join_first};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Component, Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// Subfolders of PHOTOS that may contain the photos. COLMAP and nerfstudio use `images`; the
/// conversion script of the original 3DGS uses `input`.
const FOLDERS: [&str; 2] = ["images", "input"];
/// Subfolders of NeRF's synthetic scenes, one for each split.
const SETS: [&str; 3] = ["train", "test", "val"];
/// Levels of subfolders that are searched for photos, for example one folder for each camera.
const MAX_FOLDER_DEPTH: usize = 4;

/// Returns the folder that contains the photos: PHOTOS/images, PHOTOS/input, or PHOTOS itself if it
/// contains photos.
pub fn images_folder(photos: &Path) -> Option<PathBuf> {
    let named = FOLDERS
        .iter()
        .map(|name| photos.join(name))
        .find(|folder| folder.is_dir());
    named.or_else(|| holds_photos(photos).then(|| photos.to_owned()))
}

/// Returns whether a folder directly contains photos.
pub(super) fn holds_photos(folder: &Path) -> bool {
    folder
        .read_dir()
        .is_ok_and(|mut entries| entries.any(|e| e.is_ok_and(|e| is_photo(&e.path()))))
}

/// The photos of a folder, to which pose files refer by name.
pub struct Album {
    root: PathBuf,
    /// Paths of all photos, sorted.
    files: Vec<PathBuf>,
}

impl Album {
    /// Lists the photos of PHOTOS, also in subfolders of its folder of images.
    pub fn of(root: &Path) -> Self {
        let mut files = Vec::new();
        match images_folder(root).filter(|folder| folder != root) {
            Some(folder) => collect(&folder, MAX_FOLDER_DEPTH, &mut files),
            None => {
                collect(root, 0, &mut files);
                SETS.iter()
                    .for_each(|set| collect(&root.join(set), 0, &mut files));
            }
        }
        files.sort();
        Self {
            root: root.to_owned(),
            files,
        }
    }

    /// Returns the photo of each name, or `None` if it is not found.
    ///
    /// A name is a path relative to `base`, PHOTOS/images, PHOTOS/input or PHOTOS, with or without
    /// extension. If no such file exists, the longest trailing part of the path that is a file is
    /// used. The last attempt compares file names and ignores case, extension and Unicode
    /// normalization. If several photos match, the one whose parent folders agree best is used, and
    /// none on a tie. These inexact matches are discarded if the photo has an exact match, or if
    /// two names match it.
    pub fn find(&self, names: &[String], base: &Path) -> Vec<Option<PathBuf>> {
        let mut folders = vec![base.to_owned()];
        folders.extend(
            FOLDERS
                .iter()
                .map(|folder| self.root.join(folder))
                .chain([self.root.clone()]),
        );
        let mut found: Vec<Option<PathBuf>> =
            names.iter().map(|name| by_path(name, &folders)).collect();
        let taken: HashSet<PathBuf> = found.iter().flatten().cloned().collect();
        let (mut by_name, mut by_stem) = (HashMap::<_, Vec<_>>::new(), HashMap::<_, Vec<_>>::new());
        for file in self.files.iter().filter(|file| !taken.contains(*file)) {
            let name = normalized(&file.file_name().unwrap_or_default().to_string_lossy());
            by_stem
                .entry(without_ending(&name).to_owned())
                .or_default()
                .push(file);
            by_name.entry(name).or_default().push(file);
        }
        let guess = |name: &String| {
            if let Some(file) = find_by_suffix(name, &folders) {
                return Some(file).filter(|file| !taken.contains(file));
            }
            let own = normalized(parts(name).last().copied().unwrap_or_default());
            let alike = by_name
                .get(&own)
                .or_else(|| by_stem.get(&own))
                .or_else(|| by_stem.get(without_ending(&own)));
            best_folder_match(alike?, name)
        };
        let guesses: Vec<Option<PathBuf>> = names
            .iter()
            .zip(&found)
            .map(|(name, found)| if found.is_none() { guess(name) } else { None })
            .collect();
        let mut claims = BTreeMap::<&PathBuf, usize>::new();
        guesses
            .iter()
            .flatten()
            .for_each(|file| *claims.entry(file).or_default() += 1);
        for (found, guess) in found.iter_mut().zip(&guesses) {
            // Two inexact names match the same photo: neither gets it.
            if let Some(file) = guess.as_ref().filter(|file| claims[file] == 1) {
                *found = Some(file.clone());
            }
        }
        found
    }

    /// Returns a warning that lists the names without photo and the photos that exist; `None` if
    /// `names` is empty. `listed` is the number of names in the pose file `file`.
    pub fn missing(&self, names: &[String], listed: usize, file: &Path) -> Option<String> {
        if names.is_empty() {
            return None;
        }
        let there: Vec<String> = self.files.iter().map(|file| self.relative(file)).collect();
        let there = if there.is_empty() {
            "no photos".to_owned()
        } else {
            join_first(&there)
        };
        Some(format!(
            "{} of the {listed} photos that {} lists are missing: {}; the folder contains {there}",
            names.len(),
            file.display(),
            join_first(names)
        ))
    }

    /// Yields the paths, relative to PHOTOS, of all photos that are not in `used`.
    pub fn others<'a>(&'a self, used: &'a HashSet<&Path>) -> impl Iterator<Item = String> + 'a {
        self.files
            .iter()
            .filter(|file| !used.contains(file.as_path()))
            .map(|file| self.relative(file))
    }

    /// Returns the path of a photo relative to PHOTOS.
    fn relative(&self, file: &Path) -> String {
        file.strip_prefix(&self.root)
            .unwrap_or(file)
            .display()
            .to_string()
    }

    /// Returns the name of the view of each photo: its file name, with the parent folders as prefix
    /// (`a_b_1.png`) if the file name is not unique.
    pub fn view_names(&self, files: &[&Path]) -> Vec<String> {
        let own = |file: &Path| {
            file.file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned()
        };
        let mut counts = HashMap::<String, usize>::new();
        files
            .iter()
            .for_each(|file| *counts.entry(own(file)).or_default() += 1);
        let named = |file: &&Path| {
            let below = file.strip_prefix(&self.root).unwrap_or(file);
            let below = FOLDERS
                .iter()
                .find_map(|folder| below.strip_prefix(folder).ok())
                .unwrap_or(below);
            // View names become file names. Without `..` they cannot leave their folder.
            let own_part = |part: Component<'_>| {
                matches!(part, Component::Normal(_))
                    .then(|| part.as_os_str().to_string_lossy().into_owned())
            };
            let parts: Vec<String> = below.components().filter_map(own_part).collect();
            if counts[&own(file)] > 1 {
                parts.join("_")
            } else {
                own(file)
            }
        };
        files.iter().map(named).collect()
    }
}

/// Returns the file `name`, with or without extension, in the first of `folders` that has it.
fn by_path(name: &str, folders: &[PathBuf]) -> Option<PathBuf> {
    let with_endings = |bare: PathBuf| {
        let endings = ["png", "jpg", "jpeg", "JPG"]
            .map(|ending| PathBuf::from(format!("{}.{ending}", bare.display())));
        std::iter::once(bare)
            .chain(endings)
            .find(|file| file.is_file())
    };
    folders
        .iter()
        .find_map(|folder| with_endings(folder.join(name)))
}

/// Returns the file with the longest trailing part of the path `name`. Handles absolute paths and
/// paths of other operating systems.
pub(super) fn find_by_suffix(name: &str, folders: &[PathBuf]) -> Option<PathBuf> {
    let parts = parts(name);
    (0..parts.len()).find_map(|first| by_path(&parts[first..].join("/"), folders))
}

/// Appends the photos of a folder and of its subfolders, down to `depth` levels.
fn collect(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) {
    for path in folder
        .read_dir()
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
    {
        if path.is_dir() && depth > 0 {
            collect(&path, depth - 1, files);
        } else if is_photo(&path) {
            files.push(path);
        }
    }
}

/// Splits a path at `/` and `\`. Drops drive letters, `.`, `..` and empty components.
fn parts(name: &str) -> Vec<&str> {
    let is_drive = |part: &str| part.len() == 2 && part.ends_with(':');
    name.split(['/', '\\'])
        .filter(|part| !matches!(*part, "" | "." | "..") && !is_drive(part))
        .collect()
}

/// Returns the name in lower case and in Unicode normalization form C.
fn normalized(name: &str) -> String {
    name.nfc().collect::<String>().to_lowercase()
}

/// Removes the extension from a name if it is that of a photo.
fn without_ending(name: &str) -> &str {
    let known = is_photo(Path::new(name));
    name.rsplit_once('.')
        .filter(|_| known)
        .map_or(name, |(bare, _)| bare)
}

/// Returns the file whose parent folders match the most trailing folders of the path `name`; `None`
/// on a tie.
fn best_folder_match(files: &[&PathBuf], name: &str) -> Option<PathBuf> {
    let wanted: Vec<String> = parts(name)
        .iter()
        .rev()
        .skip(1)
        .map(|part| normalized(part))
        .collect();
    let agreement = |file: &PathBuf| {
        let folders = file
            .ancestors()
            .skip(1)
            .filter_map(|folder| folder.file_name())
            .map(|folder| normalized(&folder.to_string_lossy()));
        folders.zip(&wanted).take_while(|(a, b)| a == *b).count()
    };
    let best = files.iter().map(|file| agreement(file)).max()?;
    let mut alike = files.iter().filter(|file| agreement(file) == best);
    alike
        .next()
        .filter(|_| alike.next().is_none())
        .map(|file| (*file).clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn album(files: &[&str]) -> (tempfile::TempDir, Album) {
        let dir = tempfile::tempdir().unwrap();
        for file in files {
            let path = dir.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
        let album = Album::of(dir.path());
        (dir, album)
    }

    fn found(files: &[&str], names: &[&str]) -> Vec<String> {
        let (dir, album) = album(files);
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let relative = |file: Option<PathBuf>| {
            file.map_or("-".to_owned(), |f| {
                f.strip_prefix(dir.path()).unwrap().display().to_string()
            })
        };
        album
            .find(&names, dir.path())
            .into_iter()
            .map(relative)
            .collect()
    }

    #[test]
    fn names_of_other_systems_find_their_photos() {
        let files = [
            "images/a.jpg",
            "images/B  2.JPG",
            "images/caf\u{e9}.png",
            "images/cam/x.png",
        ];
        for (name, file) in [
            ("images/a.jpg", files[0]),
            ("./images/a", files[0]),
            ("a.JPG", files[0]),
            ("a.png", files[0]),
            (r"C:\Users\me\scene\images\a.jpg", files[0]),
            ("/content/drive/scene/images/a.jpg", files[0]),
            (r"..\images\b  2.jpg", files[1]),
            ("cafe\u{301}.png", files[2]),
            ("cam/x.png", files[3]),
            (r"images\cam\X.png", files[3]),
            ("b.jpg", "-"),
            ("images/x.y.png", "-"),
        ] {
            assert_eq!(found(&files, &[name]), [file], "{name}");
        }
    }

    #[test]
    fn a_photo_is_found_by_one_name_only() {
        // The first name is the path of the photo. The second matches only by its file name.
        assert_eq!(
            found(&["images/right/1.png"], &["right/1.png", "left/1.png"]),
            ["images/right/1.png", "-"]
        );
        assert_eq!(
            found(&["images/1.png"], &["left/1.PNG", "right/1.PNG"]),
            ["-", "-"]
        );
        assert_eq!(
            found(&["images/l/1.png", "images/r/1.png"], &["1.png"]),
            ["-"],
            "two photos match"
        );
        assert_eq!(
            found(&["images/l/1.png", "images/r/1.png"], &["L/1.PNG", "R/1"]),
            ["images/l/1.png", "images/r/1.png"]
        );
    }

    #[test]
    fn photos_are_found_in_the_usual_folders() {
        assert_eq!(found(&["input/a.png"], &["a.png"]), ["input/a.png"]);
        assert_eq!(
            found(&["a.png", "masks/b.png"], &["A.png", "b.png"]),
            ["a.png", "-"]
        );
        assert_eq!(
            found(
                &["train/r_0.png", "test/r_0.png"],
                &["./train/r_0", "./test/r_0"]
            ),
            ["train/r_0.png", "test/r_0.png"]
        );
        assert_eq!(
            found(&["images/._a.png", "images/a.png"], &["a"]),
            ["images/a.png"]
        );
    }

    #[test]
    fn equal_names_keep_their_folders() {
        let (_dir, album) = album(&["images/a/l/1.png", "images/a/r/1.png", "images/a/r/2.png"]);
        let files: Vec<&Path> = album.files.iter().map(PathBuf::as_path).collect();
        assert_eq!(
            album.view_names(&files),
            ["a_l_1.png", "a_r_1.png", "2.png"]
        );
    }
}
