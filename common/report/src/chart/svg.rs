//! SVG that stays small: what is drawn alike stands under one name of its looks, opaque strokes of one kind are one path,
//! and a point that no pixel shows is left out.
//!
//! Coordinates are whole tenths of a pixel ([`PIXEL`]), in the `viewBox` too, so that no number has a decimal point.

use plotters::prelude::DrawingBackend;
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingErrorKind, FontTransform,
    text_anchor::{HPos, VPos},
};
use std::{convert::Infallible, fmt::Write as _};

/// Units of drawing in a pixel.
pub(super) const PIXEL: i32 = 10;

/// A point as far as this from the line between its neighbours, in units of drawing, is not seen.
const UNSEEN: f64 = 0.15 * PIXEL as f64;
/// A font's size is the height of its line for the library, which is this many times that of the font in SVG.
const LINE_HEIGHT: f64 = 1.24;
/// From the top and from the middle of letters down to the line that they stand on, in sizes of the font.
const TOP: f64 = 0.76;
const MIDDLE: f64 = 0.26;

type Drawn = Result<(), DrawingErrorKind<Infallible>>;

/// What is drawn on.
#[derive(Debug)]
pub(super) struct Svg<'a> {
    svg: &'a mut String,
    size: (u32, u32),
    /// Looks of what is drawn at present, as attributes; empty before the first.
    looks: String,
    /// A path under way, which further opaque strokes go on with.
    path: String,
    ended: bool,
}

impl<'a> Svg<'a> {
    /// An empty one of this width and height in units of drawing.
    pub(super) fn new(svg: &'a mut String, size: (u32, u32)) -> Self {
        let pixels = |length: u32| f64::from(length) / f64::from(PIXEL);
        let (width, height) = size;
        // Writing to a String does not fail.
        let _ = write!(
            svg,
            "<svg width=\"{}\" height=\"{}\" viewBox=\"0 0 {width} {height}\" xmlns=\"http://www.w3.org/2000/svg\" \
             font-family=\"sans-serif\">",
            pixels(width),
            pixels(height)
        );
        Self { svg, size, looks: String::new(), path: String::new(), ended: false }
    }

    /// What comes next looks so.
    fn look(&mut self, looks: &str) {
        if self.looks == looks {
            return;
        }
        self.close();
        let _ = write!(self.svg, "\n<g {looks}>");
        looks.clone_into(&mut self.looks);
    }

    fn close(&mut self) {
        self.end_path();
        if !self.looks.is_empty() {
            *self.svg += "</g>";
        }
        self.looks.clear();
    }

    fn end_path(&mut self) {
        if !self.path.is_empty() {
            let _ = write!(self.svg, "<path d=\"{}\"/>", self.path);
            self.path.clear();
        }
    }

    /// Strokes that let something through add up where they cross, so each is a path of its own.
    fn stroke(&mut self, points: &[BackendCoord], colour: BackendColor, width: u32) {
        if colour.alpha <= 0.0 || points.len() < 2 {
            return;
        }
        self.look(&stroked(colour, width));
        trace(&mut self.path, &thinned(points));
        if colour.alpha < 1.0 {
            self.end_path();
        }
    }

    fn fill(&mut self, corners: &[BackendCoord], colour: BackendColor) {
        if colour.alpha <= 0.0 || corners.is_empty() {
            return;
        }
        self.look(&filled(colour));
        trace(&mut self.path, &thinned(corners));
        self.path.push('z');
        self.end_path();
    }
}

fn rgb(colour: BackendColor) -> String {
    let (red, green, blue) = colour.rgb;
    format!("#{red:02x}{green:02x}{blue:02x}")
}

/// An attribute of this kind ("stroke", "fill"), and that of what it lets through.
fn coloured(kind: &str, colour: BackendColor) -> String {
    let opacity = match colour.alpha {
        opaque if opaque >= 1.0 => String::new(),
        alpha => format!(" {kind}-opacity=\"{alpha}\""),
    };
    format!("{kind}=\"{}\"{opacity}", rgb(colour))
}

fn stroked(colour: BackendColor, width: u32) -> String {
    format!("fill=\"none\" {} stroke-width=\"{width}\"", coloured("stroke", colour))
}

fn filled(colour: BackendColor) -> String {
    coloured("fill", colour)
}

/// Adds a line through these points to a path: its first point by its place, others by the way from the one before.
fn trace(path: &mut String, points: &[BackendCoord]) {
    let Some((first, rest)) = points.split_first() else { return };
    let _ = write!(path, "M{} {}", first.0, first.1);
    let (mut before, mut command) = (*first, ' ');
    for &point in rest {
        let (x, y) = (point.0 - before.0, point.1 - before.1);
        let (next, numbers) = match (x, y) {
            (x, 0) => ('h', vec![x]),
            (0, y) => ('v', vec![y]),
            (x, y) => ('l', vec![x, y]),
        };
        for (at, number) in numbers.into_iter().enumerate() {
            if at == 0 && next != command {
                path.push(next);
            } else if number >= 0 {
                // A minus sign separates numbers by itself.
                path.push(' ');
            }
            let _ = write!(path, "{number}");
        }
        (before, command) = (point, next);
    }
}

/// The points of a line that are needed to draw it: between any two of them that stay, none lies further from the straight
/// line than is seen (Douglas and Peucker, 1973).
fn thinned(points: &[BackendCoord]) -> Vec<BackendCoord> {
    let Some(last) = points.len().checked_sub(1) else { return Vec::new() };
    let mut stays = vec![false; points.len()];
    (stays[0], stays[last]) = (true, true);
    let mut parts = vec![(0, last)];
    while let Some((from, to)) = parts.pop() {
        let between = (from + 1)..to;
        let far = between.map(|at| (at, off(points[at], points[from], points[to])));
        let Some((at, distance)) = far.max_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
        if distance > UNSEEN {
            stays[at] = true;
            parts.extend([(from, at), (at, to)]);
        }
    }
    points.iter().zip(stays).filter(|(_, stays)| *stays).map(|(point, _)| *point).collect()
}

/// How far a point is from the line between two others, ends included.
fn off(point: BackendCoord, from: BackendCoord, to: BackendCoord) -> f64 {
    let way = |from: BackendCoord, to: BackendCoord| [f64::from(to.0 - from.0), f64::from(to.1 - from.1)];
    let ([x, y], [along_x, along_y]) = (way(from, point), way(from, to));
    let length = along_x * along_x + along_y * along_y;
    let share = if length > 0.0 { ((x * along_x + y * along_y) / length).clamp(0.0, 1.0) } else { 0.0 };
    (x - share * along_x).hypot(y - share * along_y)
}

impl DrawingBackend for Svg<'_> {
    type ErrorType = Infallible;

    fn get_size(&self) -> (u32, u32) {
        self.size
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        if !self.ended {
            self.close();
            *self.svg += "\n</svg>\n";
            self.ended = true;
        }
        Ok(())
    }

    fn draw_pixel(&mut self, (x, y): BackendCoord, colour: BackendColor) -> Drawn {
        self.fill(&[(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)], colour);
        Ok(())
    }

    fn draw_line<S: BackendStyle>(&mut self, from: BackendCoord, to: BackendCoord, style: &S) -> Drawn {
        self.stroke(&[from, to], style.color(), style.stroke_width());
        Ok(())
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        (left, top): BackendCoord,
        (right, bottom): BackendCoord,
        style: &S,
        fill: bool,
    ) -> Drawn {
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
        if fill {
            self.fill(&corners, style.color());
        } else {
            self.stroke(&[&corners[..], &corners[..1]].concat(), style.color(), style.stroke_width());
        }
        Ok(())
    }

    fn draw_path<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        path: I,
        style: &S,
    ) -> Drawn {
        self.stroke(&path.into_iter().collect::<Vec<_>>(), style.color(), style.stroke_width());
        Ok(())
    }

    fn fill_polygon<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        corners: I,
        style: &S,
    ) -> Drawn {
        self.fill(&corners.into_iter().collect::<Vec<_>>(), style.color());
        Ok(())
    }

    fn draw_circle<S: BackendStyle>(
        &mut self,
        (x, y): BackendCoord,
        radius: u32,
        style: &S,
        fill: bool,
    ) -> Drawn {
        if style.color().alpha <= 0.0 {
            return Ok(());
        }
        let looks = if fill { filled(style.color()) } else { stroked(style.color(), style.stroke_width()) };
        self.look(&looks);
        self.end_path();
        let _ = write!(self.svg, "<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"/>");
        Ok(())
    }

    /// Words stand where the library has them if they are in the page's sans-serif, about whose shapes it guesses.
    fn draw_text<S: BackendTextStyle>(&mut self, text: &str, style: &S, (x, y): BackendCoord) -> Drawn {
        if style.color().alpha <= 0.0 {
            return Ok(());
        }
        let size = style.size() / LINE_HEIGHT;
        let anchor = match style.anchor().h_pos {
            HPos::Left => "",
            HPos::Center => " text-anchor=\"middle\"",
            HPos::Right => " text-anchor=\"end\"",
        };
        self.look(&format!("{} font-size=\"{}\"{anchor}", filled(style.color()), size.round()));
        self.end_path();
        let down = match style.anchor().v_pos {
            VPos::Top => TOP * size,
            VPos::Center => MIDDLE * size,
            VPos::Bottom => -MIDDLE * size,
        };
        let (down, degrees) = (down.round() as i32, degrees(&style.transform()));
        let place = match degrees {
            0 => format!("x=\"{x}\" y=\"{}\"", y + down),
            // Turned about its place, words go down to their line first.
            degrees => format!("transform=\"translate({x} {y})rotate({degrees})\" y=\"{down}\""),
        };
        let _ = write!(self.svg, "<text {place}>{}</text>", crate::table::escaped(text));
        Ok(())
    }
}

fn degrees(transform: &FontTransform) -> u32 {
    match transform {
        FontTransform::None => 0,
        FontTransform::Rotate90 => 90,
        FontTransform::Rotate180 => 180,
        FontTransform::Rotate270 => 270,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use plotters::prelude::{
        Circle, Color as _, IntoDrawingArea as _, IntoFont as _, PathElement, RED, TextStyle,
    };

    fn drawn(draw: impl FnOnce(&plotters::prelude::DrawingArea<Svg<'_>, plotters::coord::Shift>)) -> String {
        let mut svg = String::new();
        let area = Svg::new(&mut svg, (1000, 500)).into_drawing_area();
        draw(&area);
        area.present().unwrap();
        drop(area);
        roxmltree::Document::parse(&svg).unwrap();
        svg
    }

    #[test]
    fn opaque_strokes_of_one_kind_are_one_path_and_others_are_not() {
        let svg = drawn(|area| {
            let line = |y, alpha| PathElement::new([(0, y), (100, y), (150, y + 70)], RED.mix(alpha));
            [line(10, 1.0), line(20, 1.0), line(30, 0.5), line(40, 0.5)]
                .iter()
                .for_each(|it| area.draw(it).unwrap());
        });
        let paths: Vec<&str> =
            svg.split("<path ").skip(1).filter_map(|it| it.split_once("/>")).map(|it| it.0).collect();
        assert_eq!(
            paths,
            ["d=\"M0 10h100l50 70M0 20h100l50 70\"", "d=\"M0 30h100l50 70\"", "d=\"M0 40h100l50 70\""]
        );
        assert_eq!(svg.matches("<g ").count(), 2, "{svg}");
        assert!(svg.contains("stroke=\"#ff0000\" stroke-opacity=\"0.5\" stroke-width=\"1\""), "{svg}");
    }

    #[test]
    fn points_that_no_pixel_shows_are_left_out_and_corners_are_not() {
        // One unit off the line is a tenth of a pixel; three are seen.
        assert_eq!(thinned(&[(0, 0), (10, 1), (20, 0)]), [(0, 0), (20, 0)]);
        assert_eq!(thinned(&[(0, 0), (10, 3), (20, 0)]), [(0, 0), (10, 3), (20, 0)]);
        // A way there and back has an end that is no end of the list.
        assert_eq!(thinned(&[(0, 0), (50, 0), (0, 0)]), [(0, 0), (50, 0), (0, 0)]);
        // No point that is left out is further from what is drawn than is seen.
        let wave: Vec<BackendCoord> =
            (0..1000).map(|x| (x, (200.0 * (f64::from(x) / 60.0).sin()) as i32)).collect();
        let left = thinned(&wave);
        assert!(left.len() < 250, "{}", left.len());
        let nearest = |point: &BackendCoord| {
            left.windows(2).map(|ends| off(*point, ends[0], ends[1])).fold(f64::INFINITY, f64::min)
        };
        assert!(wave.iter().all(|point| nearest(point) <= UNSEEN));
        assert!(thinned(&[]).is_empty());
        assert_eq!(thinned(&[(3, 4)]), [(3, 4)]);
    }

    #[test]
    fn words_stand_on_their_line_and_circles_where_they_belong() {
        let svg = drawn(|area| {
            area.draw_text("a < b", &TextStyle::from(("sans-serif", 124).into_font()), (10, 20)).unwrap();
            area.draw(&Circle::new((5, 6), 30, RED.filled())).unwrap();
        });
        // The font is 100 high, and its letters' tops are at the place: 76 down to the line.
        assert!(svg.contains("font-size=\"100\"><text x=\"10\" y=\"96\">a &lt; b</text>"), "{svg}");
        assert!(svg.contains("<g fill=\"#ff0000\"><circle cx=\"5\" cy=\"6\" r=\"30\"/></g>"), "{svg}");
    }
}
