//! A canvas of pixels.

use super::{
    canvas::{Align, Canvas, Font, Point, Text},
    ink::Ink,
};
use crate::failure::Failure;
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster};
use tiny_skia::{
    Color, FillRule, LineCap, Paint, Path, PathBuilder, Pixmap, PremultipliedColorU8, Rect, Stroke, Transform,
};

/// Opaque pixels.
pub struct Raster {
    pixels: Pixmap,
}

impl Raster {
    /// White paper of this width and height.
    ///
    /// # Errors
    /// When there is no memory for so many pixels.
    pub fn new([width, height]: [u32; 2]) -> Result<Self, Failure> {
        let mut pixels = Pixmap::new(width, height).ok_or_else(|| {
            Failure::runtime_message(format!("{width} x {height} pixels are too many; draw fewer episodes"))
        })?;
        pixels.fill(Color::WHITE);
        Ok(Self { pixels })
    }

    /// Red, green and blue of every pixel, row by row.
    pub fn colours(&self) -> impl ExactSizeIterator<Item = [u8; 3]> {
        // Opaque, so that premultiplied colours are colours.
        self.pixels.pixels().iter().map(|pixel| [pixel.red(), pixel.green(), pixel.blue()])
    }

    fn fill(&mut self, path: Option<Path>, ink: Ink) {
        if let Some(path) = path {
            self.pixels.fill_path(&path, &paint(ink), FillRule::Winding, Transform::identity(), None);
        }
    }

    fn stroke(&mut self, path: Option<Path>, width: f32, ink: Ink) {
        if let Some(path) = path {
            let stroke = Stroke { width, line_cap: LineCap::Butt, ..Stroke::default() };
            self.pixels.stroke_path(&path, &paint(ink), &stroke, Transform::identity(), None);
        }
    }

    /// Writes with the upper left corner of the first letter at this pixel.
    fn letters(&mut self, [left, top]: [i32; 2], font: Font, words: &str, ink: Ink) {
        let (weight, height) = face(font);
        for (at, letter) in words.chars().enumerate() {
            let Some(letter) = get_raster(letter, weight, height) else { continue };
            let left = left + (at * letter.width()) as i32;
            for (y, row) in letter.rows().enumerate() {
                for (x, &cover) in row.iter().enumerate() {
                    self.blend([left + x as i32, top + y as i32], ink, f32::from(cover) / 255.0);
                }
            }
        }
    }

    fn blend(&mut self, [x, y]: [i32; 2], ink: Ink, cover: f32) {
        let (Ok(x), Ok(y)) = (usize::try_from(x), usize::try_from(y)) else { return };
        let width = self.pixels.width() as usize;
        if x >= width || cover == 0.0 {
            return;
        }
        let Some(pixel) = self.pixels.pixels_mut().get_mut(y * width + x) else { return };
        let below = [pixel.red(), pixel.green(), pixel.blue()];
        let [red, green, blue] = ink.at(cover * ink.opacity).over(below);
        if let Some(colour) = PremultipliedColorU8::from_rgba(red, green, blue, 255) {
            *pixel = colour;
        }
    }
}

impl Canvas for Raster {
    fn rectangle(&mut self, [x, y]: Point, [width, height]: Point, ink: Ink) {
        self.fill(Rect::from_xywh(x, y, width, height).map(PathBuilder::from_rect), ink);
    }

    fn disc(&mut self, [x, y]: Point, radius: f32, ink: Ink) {
        self.fill(PathBuilder::from_circle(x, y, radius), ink);
    }

    fn ring(&mut self, [x, y]: Point, radius: f32, width: f32, ink: Ink) {
        self.stroke(PathBuilder::from_circle(x, y, radius), width, ink);
    }

    fn line(&mut self, from: Point, to: Point, width: f32, ink: Ink) {
        let [mut from, mut to] = [from, to];
        for axis in 0..2 {
            // An upright or level line of odd width is sharp in the middle of its pixels.
            if from[axis] == to[axis] && width.round() % 2.0 == 1.0 {
                (from[axis], to[axis]) = (from[axis].floor() + 0.5, to[axis].floor() + 0.5);
            }
        }
        let mut path = PathBuilder::new();
        path.move_to(from[0], from[1]);
        path.line_to(to[0], to[1]);
        self.stroke(path.finish(), width, ink);
    }

    fn triangle(&mut self, corners: [Point; 3], ink: Ink) {
        let mut path = PathBuilder::new();
        let [a, b, c] = corners;
        path.move_to(a[0], a[1]);
        path.line_to(b[0], b[1]);
        path.line_to(c[0], c[1]);
        path.close();
        self.fill(path.finish(), ink);
    }

    fn text(&mut self, Text { at: [x, y], align, font, ink, rim, words }: Text<'_>) {
        let (_, height) = face(font);
        let width = font.advance() * words.chars().count() as f32;
        let left = match align {
            Align::Left => x,
            Align::Middle => x - width / 2.0,
            Align::Right => x - width,
        };
        let (left, top) = (left.round() as i32, (y - height.val() as f32 / 2.0).round() as i32);
        if let Some(rim) = rim {
            for (dx, dy) in [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)] {
                self.letters([left + dx, top + dy], font, words, rim);
            }
        }
        self.letters([left, top], font, words, ink);
    }
}

fn paint(ink: Ink) -> Paint<'static> {
    let mut paint = Paint::default();
    let [red, green, blue] = ink.rgb;
    paint.set_color_rgba8(red, green, blue, (ink.opacity * 255.0).round() as u8);
    paint
}

fn face(font: Font) -> (FontWeight, RasterHeight) {
    match font {
        Font::Small => (FontWeight::Regular, RasterHeight::Size16),
        Font::SmallBold => (FontWeight::Bold, RasterHeight::Size16),
        Font::Large => (FontWeight::Regular, RasterHeight::Size20),
        Font::LargeBold => (FontWeight::Bold, RasterHeight::Size20),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::ink::{WHITE, WORDS};
    use noto_sans_mono_bitmap::get_raster_width;

    fn marks(draw: impl Fn(&mut Raster)) -> Vec<[usize; 2]> {
        let mut raster = Raster::new([40, 20]).unwrap();
        draw(&mut raster);
        let dark = raster.colours().enumerate().filter(|(_, colour)| colour != &[255; 3]);
        dark.map(|(at, _)| [at % 40, at / 40]).collect()
    }

    #[test]
    fn letters_are_as_wide_as_layouts_take_them_to_be() {
        for font in [Font::Small, Font::SmallBold, Font::Large, Font::LargeBold] {
            let (weight, height) = face(font);
            assert_eq!(get_raster_width(weight, height) as f32, font.advance(), "{font:?}");
        }
    }

    #[test]
    fn marks_lie_where_they_are_put() {
        let disc = marks(|raster| raster.disc([10.0, 8.0], 3.0, WORDS));
        assert!(disc.iter().all(|&[x, y]| (7..13).contains(&x) && (5..11).contains(&y)), "{disc:?}");
        assert!((26..=36).contains(&disc.len()), "about 9 pi: {}", disc.len());
        let line = marks(|raster| raster.line([2.0, 5.0], [6.0, 5.0], 1.0, WORDS));
        assert_eq!(line, [[2, 5], [3, 5], [4, 5], [5, 5]], "sharp");
        let text = |align, at, words| {
            marks(|raster| {
                raster.text(Text { at, align, font: Font::Small, ink: WORDS, rim: None, words });
            })
        };
        assert_eq!(text(Align::Left, [6.0, 10.0], "ab"), text(Align::Right, [20.0, 10.0], "ab"));
        assert_eq!(text(Align::Left, [6.0, 10.0], "ab"), text(Align::Middle, [13.0, 10.0], "ab"));
        // Beyond the edges there is nothing to write on.
        text(Align::Right, [3.0, 19.0], "long words");
        text(Align::Left, [35.0, 1.0], "long words");
    }

    #[test]
    fn a_rim_surrounds_what_it_belongs_to() {
        let text = |rim, ink| Text {
            at: [20.0, 10.0],
            align: Align::Middle,
            font: Font::SmallBold,
            ink,
            rim,
            words: "1",
        };
        let plain = marks(|raster| raster.text(text(None, WORDS)));
        let rim = marks(|raster| raster.text(text(Some(WORDS), WHITE)));
        assert!(!plain.is_empty() && rim.len() > plain.len() / 2);
    }
}
