//! VTK XML files with appended raw arrays ("VTK File Formats", vtk.org).

use std::io::{self, Write};

/// An array of a file: its declaration, and values in the order of the file.
pub(crate) struct Array<'a> {
    name: &'static str,
    number: &'static str,
    components: usize,
    tuples: usize,
    values: Box<dyn Iterator<Item = [u8; 8]> + 'a>,
    /// Bytes of a value.
    width: usize,
}

impl<'a> Array<'a> {
    pub(crate) fn doubles(name: &'static str, components: usize, tuples: usize, values: impl Iterator<Item = f64> + 'a) -> Self {
        Self { name, number: "Float64", components, tuples, values: Box::new(values.map(f64::to_le_bytes)), width: 8 }
    }

    pub(crate) fn integers(name: &'static str, tuples: usize, values: impl Iterator<Item = i64> + 'a) -> Self {
        Self { name, number: "Int64", components: 1, tuples, values: Box::new(values.map(i64::to_le_bytes)), width: 8 }
    }

    pub(crate) fn bytes(name: &'static str, tuples: usize, values: impl Iterator<Item = i8> + 'a) -> Self {
        let wide = |value: i8| [value as u8, 0, 0, 0, 0, 0, 0, 0];
        Self { name, number: "Int8", components: 1, tuples, values: Box::new(values.map(wide)), width: 1 }
    }

    /// One number.
    pub(crate) fn number(name: &'static str, value: f64) -> Self {
        Self::doubles(name, 1, 1, std::iter::once(value))
    }

    fn length(&self) -> u64 {
        (self.components * self.tuples * self.width) as u64
    }
}

/// Arrays that were declared, to be written behind the XML in this order.
#[derive(Default)]
pub(crate) struct Appended<'a> {
    arrays: Vec<Array<'a>>,
    offset: u64,
}

impl<'a> Appended<'a> {
    /// Declares arrays. Those of `FieldData` are `counted`: they state their length themselves.
    pub(crate) fn declare(&mut self, out: &mut impl Write, arrays: Vec<Array<'a>>, counted: bool) -> io::Result<()> {
        for array in arrays {
            let Array { name, number, components, tuples, .. } = &array;
            let tuples = if counted { format!(" NumberOfTuples=\"{tuples}\"") } else { String::new() };
            writeln!(
                out,
                "<DataArray type=\"{number}\" Name=\"{name}\" NumberOfComponents=\"{components}\"{tuples} format=\"appended\" offset=\"{}\"/>",
                self.offset
            )?;
            self.offset += 8 + array.length();
            self.arrays.push(array);
        }
        Ok(())
    }

    /// Ends the file.
    pub(crate) fn finish(self, out: &mut impl Write) -> io::Result<()> {
        write!(out, "<AppendedData encoding=\"raw\">\n_")?;
        for array in self.arrays {
            out.write_all(&array.length().to_le_bytes())?;
            let width = array.width;
            for value in array.values {
                out.write_all(&value[..width])?;
            }
        }
        write!(out, "\n</AppendedData>\n</VTKFile>\n")
    }
}

/// Title of a scene and source of its velocity, as far as there are any.
pub(crate) fn of_what(title: &str, source: &str) -> String {
    [title, source].into_iter().filter(|text| !text.is_empty()).collect::<Vec<_>>().join("; ")
}

/// Names and units of what a file holds: coordinates of names and units, FTLE and times; without empty ones.
pub(crate) fn unit_texts<'a>(axes: impl Iterator<Item = [&'a str; 2]>, time_unit: &str) -> impl Iterator<Item = (&'static str, String)> {
    let axes = axes.filter(|[name, _]| !name.is_empty());
    let axes = axes.map(|[name, unit]| if unit.is_empty() { name.to_owned() } else { format!("{name} [{unit}]") });
    let rate = if time_unit.is_empty() { String::new() } else { format!("1/{time_unit}") };
    let texts = [("coordinates", axes.collect::<Vec<_>>().join(", ")), ("ftle_unit", rate), ("time_unit", time_unit.to_owned())];
    texts.into_iter().filter(|(_, text)| !text.is_empty())
}

/// Begins a file of a kind, such as `ImageData`, with a comment that says what it is.
pub(crate) fn begin(out: &mut impl Write, kind: &str, about: &str) -> io::Result<()> {
    writeln!(out, "<?xml version=\"1.0\"?>\n<!-- {}, by ridgewatch {} -->", comment(about), env!("CARGO_PKG_VERSION"))?;
    writeln!(out, "<VTKFile type=\"{kind}\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">")
}

/// A text of `FieldData`, as codes of its characters that end at 0.
pub(crate) fn text(out: &mut impl Write, name: &str, text: &str) -> io::Result<()> {
    let codes: String = text.bytes().map(|byte| format!("{byte} ")).collect();
    writeln!(out, "<Array type=\"String\" Name=\"{name}\" NumberOfTuples=\"1\" format=\"ascii\">{codes}0</Array>")
}

/// Text of an attribute.
pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

/// Text inside an XML comment, which ends at two dashes.
fn comment(text: &str) -> String {
    text.replace("--", "- -").trim_end_matches('-').chars().filter(|c| !c.is_control()).collect()
}
