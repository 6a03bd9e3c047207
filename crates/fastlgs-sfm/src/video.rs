//! Selects photos from a video: sharp frames, dense enough that neighbouring photos can be matched.
//! ffmpeg decodes the video.

use crate::keypoints::{self, Keypoints};
use crate::matching::matches;
use crate::photo_quality::PhotoStats;
use crate::process_output::lines;
use crate::{Error, Result};
use fastlgs_core::stats;
use image::GrayImage;
use serde::Deserialize;
use std::collections::VecDeque;
use std::io::{BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;

/// Frames per second that are examined.
const RATE: u32 = 15;
/// Number of consecutive frames of which only the sharpest is a candidate.
const WINDOW: usize = 3;
/// Largest longer side, in pixels, of the images on which frames are compared.
const FRAME_SIDE: u32 = 480;
/// Smallest share of matched key points of neighbouring photos, relative to the largest share of
/// consecutive candidates.
const SHARED: f32 = 2.0 / 3.0;
/// A candidate is blurred if its sharpness, relative to the median of recent candidates, is below
/// this value.
const BLURRED: f32 = 0.4;
/// After this many consecutive blurred candidates, the next one is accepted: the content is plain
/// rather than blurred. Also the number of recent candidates of the median.
const MAX_BLURRED_RUN: usize = 10;
/// Largest number of photos. More are thinned out evenly.
const MAX_PHOTOS: usize = 300;

/// Returns whether the file extension is that of a video.
pub fn is_video(path: &Path) -> bool {
    let ending = path
        .extension()
        .and_then(|e| e.to_str())
        .unwrap_or_default()
        .to_ascii_lowercase();
    matches!(
        ending.as_str(),
        "mp4" | "mov" | "m4v" | "mkv" | "webm" | "avi"
    )
}

/// Writes selected frames of a video as JPEG files into the new folder `images`, in order of time.
/// Returns their number.
///
/// `progress` receives the seconds examined and the number of selected frames. Its error stops the
/// work.
///
/// # Errors
/// ffmpeg is missing or cannot read the video, or the video has fewer than three different views.
pub fn photos<E: From<Error>>(
    video: &Path,
    images: &Path,
    progress: impl Fn(f64, usize) -> Result<(), E>,
) -> Result<usize, E> {
    let frames = choose(video, progress)?;
    Ok(write(video, frames, images)?)
}

/// Writes the given frames of a video, and returns their number.
fn write(video: &Path, frames: Vec<u32>, images: &Path) -> Result<usize> {
    if frames.len() < 3 {
        return Err(Error::StillVideo {
            video: video.to_owned(),
            views: frames.len(),
        });
    }
    let frames = thinned(frames, MAX_PHOTOS);
    std::fs::create_dir_all(images).map_err(fastlgs_core::Error::io(images))?;
    let these = frames
        .iter()
        .map(|n| format!("eq(n,{n})"))
        .collect::<Vec<_>>()
        .join("+");
    // Continuous time stamps: with gaps, ffmpeg would repeat frames.
    // Conversion through RGB: JPEG has one colour matrix, videos have several.
    let filter = format!("fps={RATE},select='{these}',setpts=N/({RATE}*TB),format=rgb24");
    Ffmpeg::start(
        video,
        images,
        &filter,
        &[
            "-r",
            &RATE.to_string(),
            "-pix_fmt",
            "yuvj420p",
            "-q:v",
            "2",
            "%04d.jpg",
        ],
    )?
    .finish()?;
    Ok(frames.len())
}

/// Properties of a video stream, as ffprobe reports them; empty if unknown.
#[derive(Default, Deserialize)]
struct Stream {
    #[serde(default)]
    color_transfer: String,
    #[serde(default)]
    color_primaries: String,
    #[serde(default)]
    color_space: String,
    #[serde(default)]
    sample_aspect_ratio: String,
}

#[derive(Default, Deserialize)]
struct Probe {
    #[serde(default)]
    streams: Vec<Stream>,
}

impl Stream {
    /// Runs ffprobe. If it is missing or fails, all properties are empty; ffmpeg then reports the
    /// error.
    fn of(video: &Path) -> Self {
        let entries = "stream=color_transfer,color_primaries,color_space,sample_aspect_ratio";
        let mut command = Command::new("ffprobe");
        command
            .args([
                "-v",
                "error",
                "-select_streams",
                "v:0",
                "-show_entries",
                entries,
                "-of",
                "json",
            ])
            .arg(video);
        let output = command
            .output()
            .map(|output| output.stdout)
            .unwrap_or_default();
        serde_json::from_slice::<Probe>(&output)
            .unwrap_or_default()
            .streams
            .into_iter()
            .next()
            .unwrap_or_default()
    }

    /// Returns ffmpeg filters that convert HDR (HLG, PQ) to standard range, with white at 203 cd/m2
    /// (ITU-R BT.2408), and that make pixels square.
    fn corrections(&self) -> String {
        let mut filters = Vec::new();
        if matches!(self.color_transfer.as_str(), "arib-std-b67" | "smpte2084") {
            let known = |tag: &str| !matches!(tag, "" | "unknown" | "unspecified" | "reserved");
            let primaries = if known(&self.color_primaries) {
                ""
            } else {
                ":pin=bt2020"
            };
            let matrix = if known(&self.color_space) {
                ""
            } else {
                ":min=bt2020nc"
            };
            filters.push(format!(
                "zscale=t=linear:npl=203{primaries}{matrix},format=gbrpf32le,zscale=p=bt709,tonemap=clip,\
                 zscale=t=bt709:m=bt709:r=tv,format=yuv420p"
            ));
        }
        let sides: Option<Vec<u32>> = self
            .sample_aspect_ratio
            .split(':')
            .map(|side| side.parse().ok())
            .collect();
        if let Some([width, height]) = sides.as_deref()
            && width != height
            && *width > 0
            && *height > 0
        {
            filters.push("scale='max(2,trunc(iw*sar/2)*2)':ih,setsar=1".to_owned());
        }
        filters.iter().map(|filter| format!("{filter},")).collect()
    }
}

/// A running ffmpeg process.
struct Ffmpeg<'a> {
    video: &'a Path,
    child: Child,
    /// Reads the error output, so that a full pipe does not block ffmpeg. Returns its last line.
    last_error_line: JoinHandle<Option<String>>,
}

impl<'a> Ffmpeg<'a> {
    /// Starts ffmpeg with a video filter. Relative output paths are relative to `folder`.
    fn start(video: &'a Path, folder: &Path, filter: &str, output: &[&str]) -> Result<Self> {
        let absolute = std::path::absolute(video).map_err(fastlgs_core::Error::io(video))?;
        let filter = format!("{}{filter}", Stream::of(&absolute).corrections());
        let mut command = Command::new("ffmpeg");
        command
            .args(["-nostdin", "-v", "error", "-i"])
            .arg(absolute)
            .args(["-map", "0:v:0", "-vf", &filter])
            .args(output);
        let mut child = command
            .current_dir(folder)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|_| Error::NoFfmpeg(video.to_owned()))?;
        let errors = child.stderr.take();
        let complaint = std::thread::spawn(move || lines(errors?).last());
        Ok(Self {
            video,
            child,
            last_error_line: complaint,
        })
    }

    /// Waits for the process. An error contains the last line of its error output.
    fn finish(mut self) -> Result<()> {
        let ended = self.child.wait();
        if ended.is_ok_and(|status| status.success()) {
            return Ok(());
        }
        let reason = self
            .last_error_line
            .join()
            .ok()
            .flatten()
            .unwrap_or_else(|| "it was stopped".to_owned());
        Err(Error::UnreadableVideo {
            video: self.video.to_owned(),
            reason,
        })
    }
}

/// Returns the numbers of the selected frames, counted at `RATE` frames per second.
fn choose<E: From<Error>>(
    video: &Path,
    progress: impl Fn(f64, usize) -> Result<(), E>,
) -> Result<Vec<u32>, E> {
    let filter = format!(
        "fps={RATE},scale='if(gt(iw,ih),min({FRAME_SIDE},iw),-2)':'if(gt(iw,ih),-2,min({FRAME_SIDE},ih))'"
    );
    let mut ffmpeg = Ffmpeg::start(
        video,
        Path::new("."),
        &filter,
        &["-f", "image2pipe", "-c:v", "pgm", "-pix_fmt", "gray", "-"],
    )?;
    let mut chooser = FrameSelector::default();
    let mut look = |stream| -> Result<(), E> {
        let mut stream = BufReader::new(stream);
        let mut number = 0;
        while let Some(frame) = pgm(&mut stream) {
            chooser.add_frame(number, frame)?;
            number += 1;
            progress(f64::from(number) / f64::from(RATE), chooser.chosen.len())?;
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

/// Reads the next image of a stream of portable grey maps (PGM); `None` at its end.
fn pgm(stream: &mut impl Read) -> Option<GrayImage> {
    if word(stream)? != "P5" {
        return None;
    }
    let [width, height, most] =
        [word(stream)?, word(stream)?, word(stream)?].map(|n| n.parse::<u32>().unwrap_or(0));
    let mut pixels = vec![0; width as usize * height as usize];
    stream
        .read_exact(&mut pixels)
        .ok()
        .filter(|()| most == 255)?;
    GrayImage::from_raw(width, height, pixels)
}

/// Reads the next word of a header and the white space after it.
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

/// Returns at most `most` elements, evenly spread over the list.
fn thinned(list: Vec<u32>, most: usize) -> Vec<u32> {
    if list.len() <= most {
        return list;
    }
    (0..most).map(|k| list[k * list.len() / most]).collect()
}

/// A frame that may be selected.
struct Candidate {
    number: u32,
    points: Keypoints,
}

/// Selects frames from a stream.
#[derive(Default)]
struct FrameSelector {
    /// The latest frames (number, sharpness, pixels). The sharpest one becomes a candidate.
    window: Vec<(u32, f32, GrayImage)>,
    /// Sharpness of recent candidates.
    sharpness: VecDeque<f32>,
    /// Number of consecutive blurred candidates.
    blurred: usize,
    /// Key points of the last selected frame.
    last: Option<Keypoints>,
    /// Latest candidate that shares enough key points with the last selected frame.
    near: Option<Candidate>,
    /// Largest share of matched key points between a selected frame and the next candidate.
    max_shared: f32,
    /// Numbers of the selected frames.
    chosen: Vec<u32>,
}

impl FrameSelector {
    fn add_frame(&mut self, number: u32, frame: GrayImage) -> Result<()> {
        self.window
            .push((number, PhotoStats::of_gray(&frame).sharpness, frame));
        if self.window.len() == WINDOW {
            self.close_window()
        } else {
            Ok(())
        }
    }

    /// Processes the remaining frames, and selects the last candidate that shares enough with the
    /// last selected frame.
    fn end(&mut self) -> Result<()> {
        self.close_window()?;
        self.chosen
            .extend(self.near.take().map(|candidate| candidate.number));
        Ok(())
    }

    fn close_window(&mut self) -> Result<()> {
        let sharpest = std::mem::take(&mut self.window)
            .into_iter()
            .max_by(|a, b| a.1.total_cmp(&b.1));
        let Some((number, sharpness, frame)) = sharpest else {
            return Ok(());
        };
        if stats::median(self.sharpness.iter().copied())
            .is_some_and(|usual| sharpness < BLURRED * usual)
            && self.blurred < MAX_BLURRED_RUN
        {
            self.blurred += 1;
            return Ok(());
        }
        if self.blurred >= MAX_BLURRED_RUN {
            self.sharpness.clear();
        }
        self.blurred = 0;
        self.sharpness.push_back(sharpness);
        if self.sharpness.len() > MAX_BLURRED_RUN {
            self.sharpness.pop_front();
        }
        let points = keypoints::detect(&frame)?;
        self.consider(Candidate { number, points });
        Ok(())
    }

    /// Selects the previous candidate as soon as the next one shares too few key points with the
    /// last selected frame.
    fn consider(&mut self, candidate: Candidate) {
        let Some(last) = &self.last else {
            return self.take(candidate);
        };
        let shared = share(last, &candidate.points);
        if self.near.is_none() {
            self.max_shared = self.max_shared.max(shared);
        }
        if shared >= SHARED * self.max_shared {
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

/// Returns the number of matches divided by the smaller number of key points.
fn share(a: &Keypoints, b: &Keypoints) -> f32 {
    let fewer = a.positions.len().min(b.positions.len());
    matches(a, b).len() as f32 / fewer.max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use fastlgs_core::rng::Rng;
    use image::imageops;

    /// Returns an image with random blots.
    fn wall(width: u32, height: u32) -> GrayImage {
        let mut rng = Rng::new(3, "wall");
        let mut wall = GrayImage::from_pixel(width, height, image::Luma([128]));
        for _ in 0..width * height / 200 {
            let (x, y, r) = (
                rng.range(0.0, width as f32),
                rng.range(0.0, height as f32),
                rng.range(2.0, 7.0),
            );
            let value = rng.range(0.0, 255.0) as u8;
            for (px, py) in
                (0..15).flat_map(|i| (0..15).map(move |k| (x + i as f32 - 7.0, y + k as f32 - 7.0)))
            {
                if (px - x).hypot(py - y) < r
                    && px >= 0.0
                    && py >= 0.0
                    && px < width as f32
                    && py < height as f32
                {
                    wall.put_pixel(px as u32, py as u32, image::Luma([value]));
                }
            }
        }
        imageops::blur(&wall, 0.8)
    }

    /// Runs ffmpeg; returns false if it is missing or fails.
    fn ffmpeg(arguments: &[&str]) -> bool {
        Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-y"])
            .args(arguments)
            .status()
            .is_ok_and(|status| status.success())
    }

    /// Returns the first written photo of a video.
    fn first_photo(video: &Path) -> image::RgbImage {
        let images = video.with_extension("images");
        write(video, vec![0, 2, 4], &images).unwrap();
        fastlgs_core::image_io::load_rgb(&images.join("0001.jpg")).unwrap()
    }

    #[test]
    fn non_square_pixels_and_hdr_are_converted() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let wide = at("wide.mkv");
        let source = [
            "-f",
            "lavfi",
            "-i",
            "testsrc2=size=160x120:rate=15:duration=1",
        ];
        let made = |filter: &str, codec: &[&str], path: &Path| {
            let output = path.to_string_lossy().into_owned();
            ffmpeg(&[source.as_slice(), &["-vf", filter], codec, &[&output]].concat())
        };
        if !made("setsar=3/2", &["-c:v", "ffv1"], &wide) {
            println!("skipped: ffmpeg is missing");
            return;
        }
        assert_eq!(first_photo(&wide).dimensions(), (240, 120));
        let plain = at("plain.mkv");
        let tagged = "format=yuv420p,setparams=color_primaries=bt709:color_trc=bt709:colorspace=bt709:range=tv";
        assert!(made(tagged, &["-c:v", "ffv1"], &plain));
        let truth = first_photo(&plain);
        for (transfer, tag) in [("arib-std-b67", "hlg"), ("smpte2084", "pq")] {
            let path = at(&format!("{tag}.mkv"));
            // Standard white at 203 cd/m2, as broadcasters convert it.
            let up = format!(
                "{tagged},zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt2020:t={transfer}:m=bt2020nc:r=tv:npl=203,format=yuv420p10le"
            );
            let tags = [
                "-c:v",
                "ffv1",
                "-color_trc",
                transfer,
                "-color_primaries",
                "bt2020",
                "-colorspace",
                "bt2020nc",
            ];
            if !made(&up, &tags, &path) {
                println!("skipped: ffmpeg has no zscale");
                return;
            }
            let shown = first_photo(&path);
            let squares = shown
                .as_raw()
                .iter()
                .zip(truth.as_raw())
                .map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2))
                .sum::<f64>();
            let psnr = -10.0 * (squares / truth.as_raw().len() as f64 / 255.0f64.powi(2)).log10();
            // Without conversion it is 12 dB. The rest is the loss of out-of-gamut colours.
            assert!(
                psnr > 22.0,
                "{tag}: PSNR of {psnr} dB to the original colours"
            );
        }
    }

    #[test]
    fn selected_frames_overlap_and_are_sharp() {
        let wall = wall(900, 160);
        // The camera moves along the wall by two pixels per frame and shows 240 of its pixels. It
        // pauses once, and its frames are blurred for a while.
        let at = |frame: u32| {
            2 * if frame < 100 {
                frame
            } else {
                frame.saturating_sub(60).max(100)
            }
        };
        let shaken = |frame: u32| (40..55).contains(&frame);
        let mut chooser = FrameSelector::default();
        for frame in 0..300 {
            let sharp = imageops::crop_imm(&wall, at(frame), 0, 240, 160).to_image();
            chooser
                .add_frame(
                    frame,
                    if shaken(frame) {
                        imageops::blur(&sharp, 3.0)
                    } else {
                        sharp
                    },
                )
                .unwrap();
        }
        chooser.end().unwrap();
        let chosen = &chooser.chosen;
        println!("chosen: {chosen:?}");
        assert!(chosen.iter().all(|frame| !shaken(*frame)));
        let steps: Vec<u32> = chosen
            .windows(2)
            .map(|pair| at(pair[1]) - at(pair[0]))
            .collect();
        // A third of 240 pixels, with a tolerance for key points lost near the border.
        assert!(steps.iter().all(|step| *step <= 84), "{steps:?}");
        assert!(
            steps[..steps.len() - 1].iter().all(|step| *step >= 40),
            "{steps:?}"
        );
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
        let mut stream =
            std::io::Cursor::new(b"P5\n2 1\n255\n\x01\x02P5\n2 1\n255\n\x20\x0aP5\n2".to_vec());
        assert_eq!(pgm(&mut stream).unwrap().into_raw(), [1, 2]);
        assert_eq!(
            pgm(&mut stream).unwrap().into_raw(),
            [32, 10],
            "bytes that are white space must be read as pixels"
        );
        assert!(pgm(&mut stream).is_none());
    }
}
