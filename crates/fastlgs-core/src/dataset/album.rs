//! The photos of a folder, and how the names in poses' files find them.

use super::{first_few, is_photo};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Component, Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// Folders of photos within PHOTOS: of COLMAP and nerfstudio, and of the original 3DGS's conversion script.
const FOLDERS: [&str; 2] = ["images", "input"];
/// The sets of NeRF's synthetic scenes.
const SETS: [&str; 3] = ["train", "test", "val"];
/// Folders below a folder of photos that are searched, such as one for each camera.
const DEPTH: usize = 4;

/// The folder that photos lie in: PHOTOS/images, PHOTOS/input, or PHOTOS itself where photos lie in it.
pub fn images_folder(photos: &Path) -> Option<PathBuf> {
    let named = FOLDERS.iter().map(|name| photos.join(name)).find(|folder| folder.is_dir());
    named.or_else(|| holds_photos(photos).then(|| photos.to_owned()))
}

/// Whether photos lie in a folder.
pub(super) fn holds_photos(folder: &Path) -> bool {
    folder.read_dir().is_ok_and(|mut entries| entries.any(|e| e.is_ok_and(|e| is_photo(&e.path()))))
}

/// The photos that poses may name.
pub struct Album {
    root: PathBuf,
    /// Every photo in the folders of photos.
    files: Vec<PathBuf>,
}

impl Album {
    /// The photos of a folder PHOTOS.
    pub fn of(root: &Path) -> Self {
        let mut files = Vec::new();
        match images_folder(root).filter(|folder| folder != root) {
            Some(folder) => collect(&folder, DEPTH, &mut files),
            None => {
                collect(root, 0, &mut files);
                SETS.iter().for_each(|set| collect(&root.join(set), 0, &mut files));
            }
        }
        files.sort();
        Self { root: root.to_owned(), files }
    }

    /// The photo of each name, or nothing. `base` is the folder that names are relative to, if it is not PHOTOS/images.
    ///
    /// A name is a path, with or without an ending. A name that no path has finds the one photo that its last parts name, or whose name differs
    /// only in case, in its ending, or in how accents are encoded, unless another name means the same photo.
    pub fn find(&self, names: &[String], base: &Path) -> Vec<Option<PathBuf>> {
        let mut folders = vec![base.to_owned()];
        folders.extend(FOLDERS.iter().map(|folder| self.root.join(folder)).chain([self.root.clone()]));
        let mut found: Vec<Option<PathBuf>> = names.iter().map(|name| by_path(name, &folders)).collect();
        let taken: HashSet<PathBuf> = found.iter().flatten().cloned().collect();
        let (mut whole, mut bare) = (HashMap::<_, Vec<_>>::new(), HashMap::<_, Vec<_>>::new());
        for file in self.files.iter().filter(|file| !taken.contains(*file)) {
            let name = plain(&file.file_name().unwrap_or_default().to_string_lossy());
            bare.entry(without_ending(&name).to_owned()).or_default().push(file);
            whole.entry(name).or_default().push(file);
        }
        let guess = |name: &String| {
            if let Some(file) = by_last_parts(name, &folders) {
                return Some(file).filter(|file| !taken.contains(file));
            }
            let own = plain(parts(name).last().copied().unwrap_or_default());
            let alike = whole.get(&own).or_else(|| bare.get(&own)).or_else(|| bare.get(without_ending(&own)));
            nearest(alike?, name)
        };
        let guesses: Vec<Option<PathBuf>> =
            names.iter().zip(&found).map(|(name, found)| if found.is_none() { guess(name) } else { None }).collect();
        let mut claims = BTreeMap::<&PathBuf, usize>::new();
        guesses.iter().flatten().for_each(|file| *claims.entry(file).or_default() += 1);
        for (found, guess) in found.iter_mut().zip(&guesses) {
            // A photo that two names might mean is none's.
            if let Some(file) = guess.as_ref().filter(|file| claims[file] == 1) {
                *found = Some(file.clone());
            }
        }
        found
    }

    /// What was looked for and what there is, where some names found no photo.
    pub fn missing(&self, names: &[String], listed: usize, file: &Path) -> Option<String> {
        if names.is_empty() {
            return None;
        }
        let there: Vec<String> = self.files.iter().map(|file| self.relative(file)).collect();
        let there = if there.is_empty() { "no photos".to_owned() } else { first_few(&there) };
        Some(format!(
            "{} of {listed} photos that {} names are not there: {}; there are {there}",
            names.len(),
            file.display(),
            first_few(names)
        ))
    }

    /// The photos that are none of these.
    pub fn others<'a>(&'a self, used: &'a HashSet<&Path>) -> impl Iterator<Item = String> + 'a {
        self.files.iter().filter(|file| !used.contains(file.as_path())).map(|file| self.relative(file))
    }

    /// A photo's path below PHOTOS.
    fn relative(&self, file: &Path) -> String {
        file.strip_prefix(&self.root).unwrap_or(file).display().to_string()
    }

    /// Names of the views that photos become: their file names, with the folders before them where file names are not unique.
    pub fn view_names(&self, files: &[&Path]) -> Vec<String> {
        let own = |file: &Path| file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut counts = HashMap::<String, usize>::new();
        files.iter().for_each(|file| *counts.entry(own(file)).or_default() += 1);
        let named = |file: &&Path| {
            let below = file.strip_prefix(&self.root).unwrap_or(file);
            let below = FOLDERS.iter().find_map(|folder| below.strip_prefix(folder).ok()).unwrap_or(below);
            // A name never leads out of the folder that it is a name in.
            let own_part =
                |part: Component<'_>| matches!(part, Component::Normal(_)).then(|| part.as_os_str().to_string_lossy().into_owned());
            let parts: Vec<String> = below.components().filter_map(own_part).collect();
            if counts[&own(file)] > 1 { parts.join("_") } else { own(file) }
        };
        files.iter().map(named).collect()
    }
}

/// The file at a path, with or without an ending, below one of these folders.
fn by_path(name: &str, folders: &[PathBuf]) -> Option<PathBuf> {
    let with_endings = |bare: PathBuf| {
        let endings = ["png", "jpg", "jpeg", "JPG"].map(|ending| PathBuf::from(format!("{}.{ending}", bare.display())));
        std::iter::once(bare).chain(endings).find(|file| file.is_file())
    };
    folders.iter().find_map(|folder| with_endings(folder.join(name)))
}

/// The file that the last parts of a path name, as many of them as possible: of absolute paths, and of those of other systems.
pub(super) fn by_last_parts(name: &str, folders: &[PathBuf]) -> Option<PathBuf> {
    let parts = parts(name);
    (0..parts.len()).find_map(|first| by_path(&parts[first..].join("/"), folders))
}

/// Adds the photos of a folder and of those below it.
fn collect(folder: &Path, depth: usize, files: &mut Vec<PathBuf>) {
    for path in folder.read_dir().into_iter().flatten().flatten().map(|entry| entry.path()) {
        if path.is_dir() && depth > 0 {
            collect(&path, depth - 1, files);
        } else if is_photo(&path) {
            files.push(path);
        }
    }
}

/// The parts of a path of any system that name something.
fn parts(name: &str) -> Vec<&str> {
    let is_drive = |part: &str| part.len() == 2 && part.ends_with(':');
    name.split(['/', '\\']).filter(|part| !matches!(*part, "" | "." | "..") && !is_drive(part)).collect()
}

/// A name by which names that look the same are the same.
fn plain(name: &str) -> String {
    name.nfc().collect::<String>().to_lowercase()
}

/// A name without its ending, if that is one of a photo.
fn without_ending(name: &str) -> &str {
    let known = is_photo(Path::new(name));
    name.rsplit_once('.').filter(|_| known).map_or(name, |(bare, _)| bare)
}

/// The one file whose folders agree with most of the last parts of a name; nothing where two agree equally.
fn nearest(files: &[&PathBuf], name: &str) -> Option<PathBuf> {
    let wanted: Vec<String> = parts(name).iter().rev().skip(1).map(|part| plain(part)).collect();
    let agreement = |file: &PathBuf| {
        let folders = file.ancestors().skip(1).filter_map(|folder| folder.file_name()).map(|folder| plain(&folder.to_string_lossy()));
        folders.zip(&wanted).take_while(|(a, b)| a == *b).count()
    };
    let best = files.iter().map(|file| agreement(file)).max()?;
    let mut alike = files.iter().filter(|file| agreement(file) == best);
    alike.next().filter(|_| alike.next().is_none()).map(|file| (*file).clone())
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
        let relative = |file: Option<PathBuf>| file.map_or("-".to_owned(), |f| f.strip_prefix(dir.path()).unwrap().display().to_string());
        album.find(&names, dir.path()).into_iter().map(relative).collect()
    }

    #[test]
    fn names_of_other_systems_find_their_photos() {
        let files = ["images/a.jpg", "images/B  2.JPG", "images/caf\u{e9}.png", "images/cam/x.png"];
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
        // The first has it by its path; the second would have it by its name.
        assert_eq!(found(&["images/right/1.png"], &["right/1.png", "left/1.png"]), ["images/right/1.png", "-"]);
        assert_eq!(found(&["images/1.png"], &["left/1.PNG", "right/1.PNG"]), ["-", "-"]);
        assert_eq!(found(&["images/l/1.png", "images/r/1.png"], &["1.png"]), ["-"], "two fit");
        assert_eq!(found(&["images/l/1.png", "images/r/1.png"], &["L/1.PNG", "R/1"]), ["images/l/1.png", "images/r/1.png"]);
    }

    #[test]
    fn photos_are_found_in_the_usual_folders() {
        assert_eq!(found(&["input/a.png"], &["a.png"]), ["input/a.png"]);
        assert_eq!(found(&["a.png", "masks/b.png"], &["A.png", "b.png"]), ["a.png", "-"]);
        assert_eq!(found(&["train/r_0.png", "test/r_0.png"], &["./train/r_0", "./test/r_0"]), ["train/r_0.png", "test/r_0.png"]);
        assert_eq!(found(&["images/._a.png", "images/a.png"], &["a"]), ["images/a.png"]);
    }

    #[test]
    fn equal_names_keep_their_folders() {
        let (_dir, album) = album(&["images/a/l/1.png", "images/a/r/1.png", "images/a/r/2.png"]);
        let files: Vec<&Path> = album.files.iter().map(PathBuf::as_path).collect();
        assert_eq!(album.view_names(&files), ["a_l_1.png", "a_r_1.png", "2.png"]);
    }
}
