//! Every step of every episode, one after the other, as an animated GIF.

use super::{
    ink,
    layout::{self, FRAME},
    raster::Raster,
    recording::{Film, Recording},
};
use crate::failure::Failure;
use gif::{DisposalMethod, Encoder, Frame, Repeat};
use std::{collections::HashMap, iter::repeat_n};

/// A step is shown so long, in hundredths of a second: about eight a second.
const STEP: u16 = 12;
/// The beginning of an episode.
const BEGINNING: u16 = 60;
/// The end of an episode.
const END: u16 = 200;

/// So many pictures after each other have about the same colours.
const SAMPLED: usize = 4;
/// Shades of each body's colour that every palette has.
const SHADES: u8 = 16;
/// Colours of a palette: one index is left for what has not changed.
const COLOURS: usize = 255;
/// That index.
const UNCHANGED: u8 = 255;

/// The file.
///
/// # Errors
/// When there is no memory for it.
pub fn encode(film: &Film) -> Result<Vec<u8>, Failure> {
    let lengths = film.episodes.iter().map(Recording::steps).enumerate();
    let shots: Vec<(usize, usize)> =
        lengths.flat_map(|(episode, steps)| (0..=steps).map(move |step| (episode, step))).collect();
    let draw = |&(episode, step): &(usize, usize)| -> Result<Vec<[u8; 3]>, Failure> {
        let mut raster = Raster::new(FRAME)?;
        layout::frame(&mut raster, film, episode, step);
        Ok(raster.colours().collect())
    };

    // One picture in a few has the colours of all; all pictures at once would take much memory.
    let mut counts = HashMap::new();
    for shot in shots.iter().step_by(SAMPLED) {
        for run in draw(shot)?.chunk_by(|a, b| a == b) {
            *counts.entry(run[0]).or_insert(0) += run.len();
        }
    }
    // Trails are thin, so their colours are rare; but grey ones would be wrong.
    for kind in film.kinds() {
        for shade in 1..=SHADES {
            let ink = ink::body(kind).at(f32::from(shade) / f32::from(SHADES));
            counts.insert(ink.over(ink::GROUND.rgb), usize::MAX);
        }
    }
    let mut palette = Palette::of(counts);

    let [width, height] = FRAME.map(|size| size as u16);
    let mut encoder = Encoder::new(Vec::new(), width, height, &palette.bytes()).map_err(Failure::runtime)?;
    encoder.set_repeat(Repeat::Infinite).map_err(Failure::runtime)?;
    let mut before: Option<Vec<u8>> = None;
    for shot in &shots {
        let picture: Vec<u8> = draw(shot)?
            .chunk_by(|a, b| a == b)
            .flat_map(|run| repeat_n(palette.index(run[0]), run.len()))
            .collect();
        let mut frame = match &before {
            Some(before) => changes(before, &picture, usize::from(width)),
            None => Frame { width, height, buffer: picture.clone().into(), ..Frame::default() },
        };
        frame.delay = match shot {
            (_, 0) => BEGINNING,
            (episode, step) if *step == film.episodes[*episode].steps() => END,
            _ => STEP,
        };
        frame.dispose = DisposalMethod::Keep;
        encoder.write_frame(&frame).map_err(Failure::runtime)?;
        before = Some(picture);
    }
    encoder.into_inner().map_err(Failure::runtime)
}

/// The smallest rectangle that holds all that has changed, and of it only that.
fn changes(before: &[u8], picture: &[u8], width: usize) -> Frame<'static> {
    let changed = |at: &usize| before[*at] != picture[*at];
    let places = || (0..picture.len()).filter(changed);
    let (top, bottom) = (places().next().unwrap_or(0) / width, places().next_back().unwrap_or(0) / width);
    let left = places().map(|at| at % width).min().unwrap_or(0);
    let right = places().map(|at| at % width).max().unwrap_or(0);
    let pixels = (top..=bottom).flat_map(|y| y * width + left..=y * width + right);
    let buffer: Vec<u8> = pixels.map(|at| if changed(&at) { picture[at] } else { UNCHANGED }).collect();
    Frame {
        left: left as u16,
        top: top as u16,
        width: (right - left + 1) as u16,
        height: (bottom - top + 1) as u16,
        transparent: Some(UNCHANGED),
        buffer: buffer.into(),
        ..Frame::default()
    }
}

/// The colours that come most often. Pictures here are flat: what else there is lies on edges and in fading
/// trails, where the nearest colour is not told from the true one.
struct Palette {
    colours: Vec<[u8; 3]>,
    /// What was looked up before.
    known: HashMap<[u8; 3], u8>,
}

impl Palette {
    fn of(counts: HashMap<[u8; 3], usize>) -> Self {
        let mut counts: Vec<_> = counts.into_iter().collect();
        // By colour where they come equally often: the same episode gives the same file.
        counts.sort_by_key(|&(colour, count)| (std::cmp::Reverse(count), colour));
        let colours: Vec<_> = counts.into_iter().map(|(colour, _)| colour).take(COLOURS).collect();
        Self { colours, known: HashMap::new() }
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes: Vec<u8> = self.colours.iter().flatten().copied().collect();
        bytes.resize(3 * (COLOURS + 1), 0);
        bytes
    }

    fn index(&mut self, colour: [u8; 3]) -> u8 {
        *self.known.entry(colour).or_insert_with(|| {
            let distance = |other: &[u8; 3]| -> i32 {
                colour.iter().zip(other).map(|(&a, &b)| (i32::from(a) - i32::from(b)).pow(2)).sum()
            };
            let nearest = self.colours.iter().enumerate().min_by_key(|(_, other)| distance(other));
            nearest.map_or(0, |(index, _)| index as u8)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::recording::tests::film;

    #[test]
    fn only_what_has_changed_is_written_again() {
        let before = [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1];
        let now = [1, 1, 1, 1, 1, 2, 1, 1, 1, 1, 3, 1];
        let frame = changes(&before, &now, 4);
        assert_eq!((frame.left, frame.top, frame.width, frame.height), (1, 1, 2, 2));
        assert_eq!(*frame.buffer, [2, UNCHANGED, UNCHANGED, 3]);
        let nothing = changes(&before, &before, 4);
        assert_eq!((nothing.width, nothing.height, &*nothing.buffer), (1, 1, &[UNCHANGED][..]));
    }

    #[test]
    fn a_fading_trail_keeps_its_colour() {
        let film = film(0.2);
        let bytes = encode(&film).unwrap();
        let decoder = gif::DecodeOptions::new().read_info(&bytes[..]).unwrap();
        let palette: Vec<_> = decoder.global_palette().unwrap().chunks_exact(3).collect();
        // Half of (213, 94, 0) over white.
        assert!(palette.contains(&&[234, 175, 128][..]), "{palette:?}");
    }

    #[test]
    fn common_colours_stay_as_they_are_and_rare_ones_become_their_nearest() {
        let mut counts: HashMap<[u8; 3], usize> = (0..=254).map(|grey| ([grey; 3], 10)).collect();
        counts.insert([255, 0, 0], 1);
        counts.insert([7, 7, 9], 1);
        let mut palette = Palette::of(counts);
        assert_eq!(palette.colours.len(), COLOURS);
        for grey in 0..=254 {
            let index = palette.index([grey; 3]);
            assert_eq!(palette.colours[usize::from(index)], [grey; 3]);
        }
        let nearest = usize::from(palette.index([7, 7, 9]));
        assert!([7, 8].map(|grey| [grey; 3]).contains(&palette.colours[nearest]));
        assert_eq!(palette.bytes().len(), 3 * 256);
    }
}
