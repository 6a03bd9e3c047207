//! Photos from a video: its sharp frames, as many of them as neighbours need to know each other again. ffmpeg decodes.

use crate::keypoints::{self, Keypoints};
use crate::matching::matches;
use crate::photo_quality::Impression;
use crate::printed::lines;
use crate::{Error, Result};
use image::GrayImage;
use std::collections::VecDeque;
use std::io::{BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;

/// Frames of a second that are looked at.
const RATE: u32 = 15;
/// Of so many frames in a row the sharpest one may become a photo.
const WINDOW: usize = 3;
/// Longer side of the pictures on which frames are compared.
const SIDE: u32 = 480;
/// Two neighbouring photos share at least this much of the key points that two frames in a row share.
const SHARED: f32 = 2.0 / 3.0;
/// A frame this much less sharp than those before it is blurred.
const BLURRED: f32 = 0.4;
/// After so many blurred ones what is seen is not blurred but plain.
const PATIENCE: usize = 10;
/// Most photos: those of a longer video are thinned out.
const MOST: usize = 300;

/// Whether a file's ending is that of a video.
pub fn is_video(path: &Path) -> bool {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    matches!(ending.as_str(), "mp4" | "mov" | "m4v" | "mkv" | "webm" | "avi")
}

/// Writes the photos that a video is worth into the new folder `images` as JPEG files, in its order. `say` is told the seconds that were looked at and the
/// photos that were chosen, and may stop the work by an error. Returns how many photos there are.
///
/// # Errors
/// When ffmpeg is missing or cannot read the video, and when the video hardly moves.
pub fn photos<E: From<Error>>(video: &Path, images: &Path, say: impl Fn(f64, usize) -> Result<(), E>) -> Result<usize, E> {
    let frames = choose(video, say)?;
    Ok(write(video, frames, images)?)
}

/// Writes these frames of a video, and returns how many they are.
fn write(video: &Path, frames: Vec<u32>, images: &Path) -> Result<usize> {
    if frames.len() < 3 {
        return Err(Error::Invalid(format!(
            "{}: {} different views; the camera must move around what it shows, for at least some seconds",
            video.display(),
            frames.len()
        )));
    }
    let frames = thinned(frames, MOST);
    std::fs::create_dir_all(images).map_err(fastlgs_core::Error::io(images))?;
    let these = frames.iter().map(|n| format!("eq(n,{n})")).collect::<Vec<_>>().join("+");
    // Times without gaps: else frames would be repeated to fill them.
    let filter = format!("fps={RATE},select='{these}',setpts=N/({RATE}*TB)");
    Ffmpeg::start(video, images, &filter, &["-r", &RATE.to_string(), "-q:v", "2", "%04d.jpg"])?.finish()?;
    Ok(frames.len())
}

/// ffmpeg at work on a video.
struct Ffmpeg<'a> {
    video: &'a Path,
    child: Child,
    /// Reads what it complains of, so that a full pipe does not stop it, and gives the last line.
    complaint: JoinHandle<Option<String>>,
}

impl<'a> Ffmpeg<'a> {
    /// Sends the pictures of a video through a filter; outputs without a folder are written to `folder`.
    fn start(video: &'a Path, folder: &Path, filter: &str, output: &[&str]) -> Result<Self> {
        let absolute = std::path::absolute(video).map_err(fastlgs_core::Error::io(video))?;
        let mut command = Command::new("ffmpeg");
        command.args(["-nostdin", "-v", "error", "-i"]).arg(absolute).args(["-map", "0:v:0", "-vf", filter]).args(output);
        let mut child = command.current_dir(folder).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().map_err(|_| {
            let mend = "install it ('apt-get install ffmpeg'), or give a folder of photos";
            Error::Missing(format!("{}: videos are read by ffmpeg, which cannot be started; {mend}", video.display()))
        })?;
        let errors = child.stderr.take();
        let complaint = std::thread::spawn(move || lines(errors?).last());
        Ok(Self { video, child, complaint })
    }

    /// Waits for its end; an error has its last line.
    fn finish(mut self) -> Result<()> {
        let ended = self.child.wait();
        if ended.is_ok_and(|status| status.success()) {
            return Ok(());
        }
        let reason = self.complaint.join().ok().flatten().unwrap_or_else(|| "it was broken off".to_owned());
        Err(Error::Invalid(format!("{}: ffmpeg cannot read this video: {reason}", self.video.display())))
    }
}

/// The numbers of the frames that become photos.
fn choose<E: From<Error>>(video: &Path, say: impl Fn(f64, usize) -> Result<(), E>) -> Result<Vec<u32>, E> {
    let filter = format!("fps={RATE},scale='if(gt(iw,ih),min({SIDE},iw),-2)':'if(gt(iw,ih),-2,min({SIDE},ih))'");
    let mut ffmpeg = Ffmpeg::start(video, Path::new("."), &filter, &["-f", "image2pipe", "-c:v", "pgm", "-pix_fmt", "gray", "-"])?;
    let mut chooser = Chooser::default();
    let mut look = |stream| -> Result<(), E> {
        let mut stream = BufReader::new(stream);
        let mut number = 0;
        while let Some(frame) = pgm(&mut stream) {
            chooser.see(number, frame)?;
            number += 1;
            say(f64::from(number) / f64::from(RATE), chooser.chosen.len())?;
        }
        Ok(chooser.end()?)
    };
    let looked = ffmpeg.child.stdout.take().map_or(Ok(()), &mut look);
    if looked.is_err() {
        let _ = ffmpeg.child.kill();
    }
    let finished = ffmpeg.finish();
    looked?;
    finished?;
    Ok(chooser.chosen)
}

/// The next picture of a stream of portable grey maps; nothing at its end.
fn pgm(stream: &mut impl Read) -> Option<GrayImage> {
    if word(stream)? != "P5" {
        return None;
    }
    let [width, height, most] = [word(stream)?, word(stream)?, word(stream)?].map(|n| n.parse::<u32>().unwrap_or(0));
    let mut pixels = vec![0; width as usize * height as usize];
    stream.read_exact(&mut pixels).ok().filter(|()| most == 255)?;
    GrayImage::from_raw(width, height, pixels)
}

/// The next word of a header, with the one white space after it.
fn word(stream: &mut impl Read) -> Option<String> {
    let (mut word, mut byte) = (String::new(), [0]);
    loop {
        stream.read_exact(&mut byte).ok()?;
        if byte[0].is_ascii_whitespace() {
            return Some(word);
        }
        word.push(char::from(byte[0]));
    }
}

/// Evenly spread ones of a list that is too long.
fn thinned(list: Vec<u32>, most: usize) -> Vec<u32> {
    if list.len() <= most {
        return list;
    }
    (0..most).map(|k| list[k * list.len() / most]).collect()
}

/// A frame that may become a photo.
struct Candidate {
    number: u32,
    points: Keypoints,
}

/// Chooses frames as they come.
#[derive(Default)]
struct Chooser {
    /// The last frames, of which the sharpest becomes a candidate.
    window: Vec<(u32, f32, GrayImage)>,
    /// How sharp the last candidates were.
    sharpness: VecDeque<f32>,
    /// Blurred candidates in a row.
    blurred: usize,
    /// Key points of the last photo.
    last: Option<Keypoints>,
    /// The latest candidate that shares enough with it.
    near: Option<Candidate>,
    /// The largest share of key points that a candidate and the next one had in common.
    usual: f32,
    /// Frames that become photos.
    chosen: Vec<u32>,
}

impl Chooser {
    fn see(&mut self, number: u32, frame: GrayImage) -> Result<()> {
        self.window.push((number, Impression::of_gray(&frame).sharpness, frame));
        if self.window.len() == WINDOW { self.close_window() } else { Ok(()) }
    }

    /// What is left is looked at, and the last view that shares enough with the last photo ends the list.
    fn end(&mut self) -> Result<()> {
        self.close_window()?;
        self.chosen.extend(self.near.take().map(|candidate| candidate.number));
        Ok(())
    }

    fn close_window(&mut self) -> Result<()> {
        let sharpest = std::mem::take(&mut self.window).into_iter().max_by(|a, b| a.1.total_cmp(&b.1));
        let Some((number, sharpness, frame)) = sharpest else { return Ok(()) };
        let mut before: Vec<f32> = self.sharpness.iter().copied().collect();
        before.sort_by(f32::total_cmp);
        if before.get(before.len() / 2).is_some_and(|usual| sharpness < BLURRED * usual) && self.blurred < PATIENCE {
            self.blurred += 1;
            return Ok(());
        }
        if self.blurred >= PATIENCE {
            self.sharpness.clear();
        }
        self.blurred = 0;
        self.sharpness.push_back(sharpness);
        if self.sharpness.len() > PATIENCE {
            self.sharpness.pop_front();
        }
        let points = keypoints::detect(&frame)?;
        self.consider(Candidate { number, points });
        Ok(())
    }

    /// A photo as soon as the next candidate would share too little with the one before.
    fn consider(&mut self, candidate: Candidate) {
        let Some(last) = &self.last else { return self.take(candidate) };
        let shared = share(last, &candidate.points);
        if self.near.is_none() {
            self.usual = self.usual.max(shared);
        }
        if shared >= SHARED * self.usual {
            self.near = Some(candidate);
        } else if let Some(near) = self.near.take() {
            self.take(near);
            self.consider(candidate);
        } else {
            self.take(candidate);
        }
    }

    fn take(&mut self, candidate: Candidate) {
        self.chosen.push(candidate.number);
        self.last = Some(candidate.points);
    }
}

/// Share of two frames' key points that are the same.
fn share(a: &Keypoints, b: &Keypoints) -> f32 {
    let fewer = a.positions.len().min(b.positions.len());
    matches(a, b).len() as f32 / fewer.max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;
    use image::imageops;

    /// A wall of blots.
    fn wall(width: u32, height: u32) -> GrayImage {
        let mut rng = Rng::new(3, "wall");
        let mut wall = GrayImage::from_pixel(width, height, image::Luma([128]));
        for _ in 0..width * height / 200 {
            let (x, y, r) = (rng.range(0.0, width as f32), rng.range(0.0, height as f32), rng.range(2.0, 7.0));
            let value = rng.range(0.0, 255.0) as u8;
            for (px, py) in (0..15).flat_map(|i| (0..15).map(move |k| (x + i as f32 - 7.0, y + k as f32 - 7.0))) {
                if (px - x).hypot(py - y) < r && px >= 0.0 && py >= 0.0 && px < width as f32 && py < height as f32 {
                    wall.put_pixel(px as u32, py as u32, image::Luma([value]));
                }
            }
        }
        imageops::blur(&wall, 0.8)
    }

    #[test]
    fn neighbours_share_two_thirds_and_blurred_frames_are_passed_over() {
        let wall = wall(900, 160);
        // The camera goes along the wall by two pixels a frame and shows 240 of it, stands still for a while, and shakes now and then.
        let at = |frame: u32| 2 * if frame < 100 { frame } else { frame.saturating_sub(60).max(100) };
        let shaken = |frame: u32| (40..55).contains(&frame);
        let mut chooser = Chooser::default();
        for frame in 0..300 {
            let sharp = imageops::crop_imm(&wall, at(frame), 0, 240, 160).to_image();
            chooser.see(frame, if shaken(frame) { imageops::blur(&sharp, 3.0) } else { sharp }).unwrap();
        }
        chooser.end().unwrap();
        let chosen = &chooser.chosen;
        println!("chosen: {chosen:?}");
        assert!(chosen.iter().all(|frame| !shaken(*frame)));
        let steps: Vec<u32> = chosen.windows(2).map(|pair| at(pair[1]) - at(pair[0])).collect();
        // A third of 240 pixels, less what is seen from the border only.
        assert!(steps.iter().all(|step| *step <= 84), "{steps:?}");
        assert!(steps[..steps.len() - 1].iter().all(|step| *step >= 40), "{steps:?}");
        assert!((6..13).contains(&chosen.len()), "{chosen:?}");
    }

    #[test]
    fn long_lists_are_thinned_evenly() {
        assert_eq!(thinned((0..10).collect(), 5), [0, 2, 4, 6, 8]);
        assert_eq!(thinned(vec![4, 9], 5), [4, 9]);
    }

    #[test]
    fn videos_are_known_by_their_ending() {
        assert!(is_video(Path::new("a/IMG_0001.MOV")) && is_video(Path::new("b.mp4")));
        assert!(!is_video(Path::new("photos")) && !is_video(Path::new("photo.jpg")));
    }

    #[test]
    fn grey_maps_follow_each_other() {
        let mut stream = std::io::Cursor::new(b"P5\n2 1\n255\n\x01\x02P5\n2 1\n255\n\x20\x0aP5\n2".to_vec());
        assert_eq!(pgm(&mut stream).unwrap().into_raw(), [1, 2]);
        assert_eq!(pgm(&mut stream).unwrap().into_raw(), [32, 10], "white space may be a pixel");
        assert!(pgm(&mut stream).is_none());
    }
}
