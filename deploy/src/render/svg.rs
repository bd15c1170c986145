//! A canvas of SVG, and the whole course of each episode on it.

use super::{
    canvas::{Align, Canvas, Point, Text},
    ink::Ink,
    layout,
    recording::Film,
};
use std::fmt::{self, Write as _};

/// Fixed-width letters, as likely found.
const FAMILY: &str = "ui-monospace,'DejaVu Sans Mono',Menlo,Consolas,monospace";
/// A fixed-width letter is about so wide, for its size.
const ADVANCE: f32 = 0.6;

/// The file.
pub fn encode(film: &Film) -> String {
    let [width, height] = layout::courses_size(film);
    let mut svg = Svg::default();
    svg.add(format_args!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
         height=\"{height}\" role=\"img\" font-family=\"{FAMILY}\">\n"
    ));
    svg.title(&format!("{} by {}", film.task, film.policy));
    layout::courses_surroundings(&mut svg, film);
    for (index, recording) in film.episodes.iter().enumerate() {
        svg.add(format_args!("<g class=\"episode\">\n"));
        svg.title(&layout::course_words(index, recording));
        layout::course(&mut svg, film, index);
        svg.add(format_args!("</g>\n"));
    }
    svg.add(format_args!("</svg>\n"));
    svg.text
}

#[derive(Default)]
struct Svg {
    text: String,
}

impl Svg {
    fn add(&mut self, mark: fmt::Arguments<'_>) {
        // Writing to a String does not fail.
        let _ = self.text.write_fmt(mark);
    }

    fn title(&mut self, words: &str) {
        self.add(format_args!("<title>{}</title>\n", escaped(words)));
    }
}

impl Canvas for Svg {
    fn rectangle(&mut self, [x, y]: Point, [width, height]: Point, ink: Ink) {
        let (x, y, width, height, fill) =
            (Short(x), Short(y), Short(width), Short(height), Paint("fill", ink));
        self.add(format_args!("<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"{fill}/>\n"));
    }

    fn disc(&mut self, [x, y]: Point, radius: f32, ink: Ink) {
        let (x, y, radius, fill) = (Short(x), Short(y), Short(radius), Paint("fill", ink));
        self.add(format_args!("<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\"{fill}/>\n"));
    }

    fn ring(&mut self, [x, y]: Point, radius: f32, width: f32, ink: Ink) {
        let (x, y, radius, width, stroke) =
            (Short(x), Short(y), Short(radius), Short(width), Paint("stroke", ink));
        self.add(format_args!(
            "<circle cx=\"{x}\" cy=\"{y}\" r=\"{radius}\" fill=\"none\" stroke-width=\"{width}\"{stroke}/>\n"
        ));
    }

    fn line(&mut self, from: Point, to: Point, width: f32, ink: Ink) {
        let ([x1, y1], [x2, y2]) = (from.map(Short), to.map(Short));
        let (width, stroke) = (Short(width), Paint("stroke", ink));
        self.add(format_args!(
            "<line x1=\"{x1}\" y1=\"{y1}\" x2=\"{x2}\" y2=\"{y2}\" stroke-width=\"{width}\"{stroke}/>\n"
        ));
    }

    fn triangle(&mut self, corners: [Point; 3], ink: Ink) {
        let [[ax, ay], [bx, by], [cx, cy]] = corners.map(|corner| corner.map(Short));
        let fill = Paint("fill", ink);
        self.add(format_args!("<polygon points=\"{ax},{ay} {bx},{by} {cx},{cy}\"{fill}/>\n"));
    }

    fn text(&mut self, Text { at: [x, y], align, font, ink, rim, words }: Text<'_>) {
        let size = font.advance() / ADVANCE;
        // Halfway up a letter is about a third of its size above its foot.
        let (x, y, size) = (Short(x), Short(y + 0.35 * size), Short(size));
        let anchor = match align {
            Align::Left => "start",
            Align::Middle => "middle",
            Align::Right => "end",
        };
        let weight = if font.is_bold() { "bold" } else { "normal" };
        let words = escaped(words);
        let mut add = |paint: fmt::Arguments<'_>| {
            self.add(format_args!(
                "<text x=\"{x}\" y=\"{y}\" font-size=\"{size}\" font-weight=\"{weight}\" \
                 text-anchor=\"{anchor}\"{paint}>{words}</text>\n"
            ));
        };
        if let Some(rim) = rim {
            // Below, as a text of its own: not every viewer knows `paint-order`.
            add(format_args!("{} stroke-width=\"2.5\" stroke-linejoin=\"round\"", Paint("stroke", rim)));
        }
        add(format_args!("{}", Paint("fill", ink)));
    }
}

/// A number with as many decimals as are seen.
struct Short(f32);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", (self.0 * 100.0).round() / 100.0)
    }
}

/// The attributes that paint a fill or a stroke.
struct Paint(&'static str, Ink);

impl fmt::Display for Paint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(what, Ink { rgb: [red, green, blue], opacity }) = self;
        write!(f, " {what}=\"#{red:02x}{green:02x}{blue:02x}\"")?;
        if *opacity < 1.0 {
            write!(f, " {what}-opacity=\"{}\"", Short(*opacity))?;
        }
        Ok(())
    }
}

fn escaped(words: &str) -> String {
    words.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::{ink, recording::tests::film};
    use rit_env::BodyKind;

    #[test]
    fn a_course_has_a_mark_for_everything_that_happened() {
        let svg = encode(&film(0.2));
        assert!(svg.contains("<title>navigation-2-2 by script:still</title>"));
        assert!(svg.contains(">episode 1: return -1.25 in 2 steps</text>"));
        // Where the two agents and the prey began; of each two parts of a trail, a dot at the foot of each, and
        // a disc at its end. The legend has a disc of each kind too.
        for (kind, bodies) in [(BodyKind::Agent, 2), (BodyKind::Prey, 1), (BodyKind::Landmark, 1)] {
            let colour = Paint("", ink::body(kind)).to_string().replace([' ', '=', '"'], "");
            let of_kind: Vec<_> = svg.lines().filter(|line| line.contains(&colour)).collect();
            let marks = |tag: &str, attribute: &str| {
                of_kind.iter().filter(|line| line.starts_with(tag) && line.contains(attribute)).count()
            };
            let moves = usize::from(kind != BodyKind::Landmark);
            assert_eq!(marks("<circle", "fill=\"none\""), moves * bodies, "beginnings of {kind:?}");
            assert_eq!(marks("<line", ""), moves * 2 * bodies, "trails of {kind:?}");
            assert_eq!(marks("<circle", " fill=\"#"), (moves * 2 + 1) * bodies + 1, "discs of {kind:?}");
        }
        // The numbers follow the decision order, not the scene's.
        let numbers = svg.lines().filter(|line| line.contains("bold") && !line.contains("stroke"));
        let numbers: Vec<_> = numbers.filter_map(|line| line.split(['>', '<']).nth(2)).collect();
        assert_eq!(numbers, ["navigation-2-2", "2", "1"]);
        // Rewards -1.5 and 0.25 share 36 pixels; the first goes down from zero, the second up.
        let reward = Paint("fill", ink::REWARD).to_string();
        let bars: Vec<_> =
            svg.lines().filter(|line| line.starts_with("<rect") && line.contains(&reward)).collect();
        assert!(bars.len() == 2 && bars[0].contains("height=\"30.86\""), "{bars:?}");
        assert!(bars[1].contains("height=\"5.14\""), "{bars:?}");
        let top = |bar: &str| bar.split('"').nth(3).map(str::to_owned);
        assert_eq!([top(bars[0]), top(bars[1])], ["523.14", "518"].map(|top| Some(top.to_owned())));
    }

    #[test]
    fn words_cannot_break_out() {
        assert_eq!(escaped("a<b>&c"), "a&lt;b&gt;&amp;c");
        assert_eq!(
            [0.1_f32 + 0.2, 12.0, -3.456].map(|number| Short(number).to_string()),
            ["0.3", "12", "-3.46"]
        );
    }
}
