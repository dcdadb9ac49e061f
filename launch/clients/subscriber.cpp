// Reads the views of a gcd-node in C++17, with libzmq and nothing else. Written from docs/protocol.md alone.
//
//   g++ -std=c++17 -O2 subscriber.cpp -lzmq -o gcd-subscriber      (Debian, Ubuntu: apt install g++ libzmq3-dev)
//   ./gcd-subscriber --view topdown --ppm frames
//
// One line on stdout for each message that may be used:
//
//   view=topdown kind=win window=3 seq=4 rev=1 skipped=0 age_ms=912.4 shape=14x256x384x3 encoding=rgb8
//   mean=101.20,98.75,93.10 hash=89ab... roles=in_transit*13,at_goal*1 synthetic=true     (one line, broken here)
//
// `mean` is the mean of each channel over the whole message (of kind depth in 1/m), `hash` FNV-1a (64 bits) of its last
// frame; both are `-` for JPEG, which this file does not decode. What was dropped, and by which rule, goes to stderr. Exit codes: 0 at the
// end of the stream, 64 a wrong option, 69 the node was silent for --timeout seconds, 70 libzmq failed, 73 a picture
// could not be written. No CURVE keys: it reads from this machine, or through a tunnel.
//
// Every pixel is generated. Use it to look around, never as evidence of free space.

#include <zmq.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cinttypes>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <unistd.h>
#include <vector>

namespace {

/// Some of the received bytes: no copy.
class Bytes {
 public:
  Bytes(const unsigned char* data, std::size_t size) : data_(data), size_(size) {}
  const unsigned char* begin() const { return data_; }
  const unsigned char* end() const { return data_ + size_; }
  const char* text() const { return reinterpret_cast<const char*>(data_); }
  std::size_t size() const { return size_; }
  unsigned char operator[](std::size_t at) const { return data_[at]; }
  /// Callers have checked that the part lies inside.
  Bytes part(std::uint64_t start, std::uint64_t size) const {
    return {data_ + static_cast<std::size_t>(start), static_cast<std::size_t>(size)};
  }

 private:
  const unsigned char* data_;
  std::size_t size_;
};

constexpr std::size_t kTopicSize = 32;
constexpr std::size_t kPrefixSize = 64;
constexpr std::size_t kMaxHeader = 65536;
constexpr std::uint64_t kMaxPayload = 64ULL << 20;  // what this client accepts; the protocol leaves it to the reader
constexpr std::int64_t kIntegerLimit = 1LL << 53;   // all integers of a header are below
constexpr int kMaxNesting = 32;                     // of a header; real ones have 4
constexpr int kQueued = 4;                          // messages waiting here with --every; the default keeps 1000

/// A message that must not be used: the text names the rule it breaks.
struct Dropped : std::runtime_error {
  using std::runtime_error::runtime_error;
};

void require(bool holds, const char* rule) {
  if (!holds) throw Dropped(rule);
}

// ---- JSON: the whole header is checked, the few fields wanted are kept as the text they stand in --------------------

/// Walks over JSON text. Keeps no tree: values are returned as the part of the text they fill.
class JsonText {
 public:
  explicit JsonText(std::string_view text) : text_(text) {}

  /// The members of the one object in the text. Of a key that comes twice the last counts.
  std::map<std::string_view, std::string_view> object() {
    std::map<std::string_view, std::string_view> members;
    space();
    walk('{', '}', [&] {
      const std::string_view key = string();
      expect(':');
      members[key] = value(1);
    });
    end();
    return members;
  }

  /// The items of the one list in the text.
  std::vector<std::string_view> list() {
    std::vector<std::string_view> items;
    space();
    walk('[', ']', [&] { items.push_back(value(1)); });
    end();
    return items;
  }

 private:
  char peek() const { return at_ < text_.size() ? text_[at_] : '\0'; }

  void space() {
    while (at_ < text_.size() && std::string_view(" \t\r\n").find(text_[at_]) != std::string_view::npos) ++at_;
  }

  void expect(char wanted) {
    space();
    require(peek() == wanted, "5: header is no JSON object");
    ++at_;
    space();
  }

  void end() {
    space();
    require(at_ == text_.size(), "5: header goes on after its JSON object");
  }

  template <typename Item>
  void walk(char open, char close, Item item) {
    expect(open);
    if (peek() != close) {
      item();
      for (space(); peek() == ','; space()) {
        expect(',');
        item();
      }
    }
    expect_close(close);
  }

  void expect_close(char close) {
    require(peek() == close, "5: header is no JSON object");
    ++at_;
  }

  std::string_view value(int depth) {
    require(depth < kMaxNesting, "5: header is nested too deeply");
    space();
    const std::size_t start = at_;
    switch (peek()) {
      case '{':
        walk('{', '}', [&] { string(), expect(':'), value(depth + 1); });
        break;
      case '[':
        walk('[', ']', [&] { value(depth + 1); });
        break;
      case '"':
        string();
        break;
      case 't':
        word("true");
        break;
      case 'f':
        word("false");
        break;
      case 'n':
        word("null");
        break;
      default:
        number();
    }
    return text_.substr(start, at_ - start);
  }

  void word(std::string_view wanted) {
    require(text_.substr(at_, wanted.size()) == wanted, "5: header is no JSON object");
    at_ += wanted.size();
  }

  /// The text between the quotes, escapes as they stand: no key or value that this client needs has any.
  std::string_view string() {
    space();
    require(peek() == '"', "5: header is no JSON object");
    const std::size_t start = ++at_;
    while (peek() != '"') {
      require(at_ < text_.size() && static_cast<unsigned char>(text_[at_]) >= 0x20, "5: header is no JSON object");
      if (text_[at_] == '\\') escape();
      ++at_;
    }
    return text_.substr(start, at_++ - start);
  }

  void escape() {
    ++at_;
    require(peek() != '\0' && std::strchr("\"\\/bfnrtu", peek()) != nullptr, "5: header is no JSON object");
    for (int digits = peek() == 'u' ? 4 : 0; digits > 0; --digits) {
      ++at_;
      require(std::isxdigit(static_cast<unsigned char>(peek())) != 0, "5: header is no JSON object");
    }
  }

  void digits() {
    require(peek() >= '0' && peek() <= '9', "5: header is no JSON object");
    while (peek() >= '0' && peek() <= '9') ++at_;
  }

  void number() {
    if (peek() == '-') ++at_;
    if (peek() == '0') {
      ++at_;
    } else {
      digits();
    }
    if (peek() == '.') {
      ++at_;
      digits();
    }
    if (peek() == 'e' || peek() == 'E') {
      ++at_;
      if (peek() == '+' || peek() == '-') ++at_;
      digits();
    }
  }

  std::string_view text_;
  std::size_t at_ = 0;
};

double to_number(std::string_view text) {
  require(!text.empty() && (text[0] == '-' || (text[0] >= '0' && text[0] <= '9')), "6: a number was wanted");
  const double number = std::strtod(std::string(text).c_str(), nullptr);
  require(std::isfinite(number), "6: a number is not finite");
  return number;
}

std::int64_t to_integer(std::string_view text) {
  require(text.find_first_of(".eE") == std::string_view::npos, "6: an integer was wanted");
  const double number = to_number(text);
  require(std::fabs(number) < static_cast<double>(kIntegerLimit), "6: an integer is not below 2^53");
  return static_cast<std::int64_t>(number);
}

std::int64_t to_count(std::string_view text) {
  const std::int64_t count = to_integer(text);
  require(count >= 0, "6: a number is negative");
  return count;
}

std::string_view to_string(std::string_view text) {
  require(text.size() >= 2 && text.front() == '"', "6: a string was wanted");
  return text.substr(1, text.size() - 2);
}

/// A pair [sec, nanosec] as milliseconds: precise to less than a microsecond for times of this century.
double to_time_ms(std::string_view text) {
  const auto pair = JsonText(text).list();
  require(pair.size() == 2, "6: a time is no pair [sec, nanosec]");
  const std::int64_t nanosec = to_count(pair[1]);
  require(nanosec < 1'000'000'000, "6: nanosec is not below 1e9");
  return static_cast<double>(to_integer(pair[0])) * 1e3 + static_cast<double>(nanosec) * 1e-6;
}

/// The fields of a header, by name.
class Header {
 public:
  explicit Header(std::string_view text) : members_(JsonText(text).object()) {}

  std::string_view operator[](std::string_view key) const {
    const auto found = members_.find(key);
    if (found == members_.end()) throw Dropped("6: the header lacks " + std::string(key));
    return found->second;
  }

  bool has(std::string_view key) const {
    const auto found = members_.find(key);
    return found != members_.end() && found->second != "null";
  }

  /// Keys that are always sent and have a default: a value other than that is nothing this client can read.
  void expect(std::string_view key, std::string_view wanted) const {
    if (has(key) && to_string((*this)[key]) != wanted) throw Dropped("6: unknown " + std::string(key));
  }

  std::vector<std::string_view> list(std::string_view key) const {
    const std::string_view text = (*this)[key];
    if (text.empty() || text.front() != '[') throw Dropped("6: " + std::string(key) + " is no list");
    return JsonText(text).list();
  }

 private:
  std::map<std::string_view, std::string_view> members_;
};

// ---- the envelope: section 2 --------------------------------------------------------------------------------------

std::uint64_t little_endian(Bytes part, std::size_t at, std::size_t size) {
  std::uint64_t number = 0;
  for (std::size_t i = size; i > 0; --i) number = number << 8 | part[at + i - 1];
  return number;
}

std::uint32_t crc32(Bytes bytes) {
  static const auto table = [] {
    std::array<std::uint32_t, 256> made{};
    for (std::uint32_t i = 0; i < 256; ++i) {
      made[i] = i;
      for (int bit = 0; bit < 8; ++bit) made[i] = made[i] >> 1 ^ (made[i] & 1 ? 0xEDB88320U : 0U);
    }
    return made;
  }();
  std::uint32_t crc = ~0U;
  for (const unsigned char byte : bytes) crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF];
  return ~crc;
}

struct Topic {
  std::string view_id;
  std::string kind;  // win, frm, std, cls, vis, depth; of the input, "src", there is frm alone

  /// All 32 bytes: ZeroMQ matches prefixes.
  std::string padded() const {
    std::string text = view_id == "src" ? "src/" + kind : "view/" + view_id + "/" + kind;
    text.resize(kTopicSize, '\0');
    return text;
  }
};

/// One message taken apart by rules 1 to 3: views into the received bytes.
struct Envelope {
  std::string_view topic;
  std::uint64_t flags;
  std::uint64_t sequence;
  std::string_view header;
  Bytes payload;

  bool has_payload() const { return (flags & 1) != 0; }
  bool ends_stream() const { return (flags & 2) != 0; }
  bool replayed() const { return (flags & 4) != 0; }
};

Envelope open_envelope(Bytes part) {
  require(part.size() >= kPrefixSize, "1: shorter than 64 bytes");
  require(std::memcmp(part.text() + kTopicSize, "GCD1", 4) == 0, "1: no message of this protocol");
  const std::uint64_t header_size = little_endian(part, 36, 2) * 16;
  const std::uint64_t payload_size = little_endian(part, 40, 8);
  require(header_size <= kMaxHeader, "2: the header is too long");
  require(payload_size <= kMaxPayload, "2: the payload is too long");
  require(part.size() == kPrefixSize + header_size + payload_size, "2: lengths do not add up");
  const auto crc = static_cast<std::uint32_t>(little_endian(part, 56, 4));
  require(crc == 0 || crc == crc32(part.part(kPrefixSize, header_size + payload_size)), "3: wrong checksum");
  return {{part.text(), kTopicSize},
          little_endian(part, 38, 2),
          little_endian(part, 48, 8),
          {part.text() + kPrefixSize, static_cast<std::size_t>(header_size)},
          part.part(kPrefixSize + header_size, payload_size)};
}

// ---- views: section 4 ---------------------------------------------------------------------------------------------

/// What views and end-of-stream messages have in common.
struct Origin {
  std::string boot_id;
  std::int64_t view_rev;
  std::int64_t window_id;
};

struct Frames {
  std::uint64_t count, height, width, channels;
  std::string encoding;
  std::vector<Bytes> payloads;  // one for each frame
};

struct View {
  Origin origin;
  Frames frames;
  std::vector<std::string> roles;
  double age_ms;        // at publication
  double published_ms;  // UTC, since the epoch
  double valid_for_ms;
  bool synthetic;
};

void check_proto(std::string_view proto) {
  require(proto.substr(0, 6) == "gcd/1." && proto.size() > 6, "5: another protocol");
  require(proto.find_first_not_of("0123456789", 6) == std::string_view::npos, "5: another protocol");
}

void check_boot_id(std::string_view boot_id) {
  const bool hex = boot_id.find_first_not_of("0123456789abcdef") == std::string_view::npos;
  require(hex && boot_id.size() == 32, "6: boot_id is not 32 hex digits");
}

Origin read_origin(const Envelope& envelope, const Header& header, const Topic& topic) {
  check_proto(to_string(header["proto"]));
  const std::string_view boot_id = to_string(header["boot_id"]);
  check_boot_id(boot_id);
  const std::string_view clock = to_string(header["clock"]);
  require(clock == "realtime" || clock == "ptp" || clock == "replay", "6: unknown clock");
  require((clock == "replay") == envelope.replayed(), "7: flags and clock disagree");
  require(to_string(header["view_id"]) == topic.view_id, "7: view_id is not that of the topic");
  return {std::string(boot_id), to_integer(header["view_rev"]), to_integer(header["window_id"])};
}

std::uint64_t channels_of(std::string_view encoding) {
  if (encoding == "rgb8" || encoding == "jpeg") return 3;
  require(encoding == "mono8" || encoding == "class8" || encoding == "invdepth16", "6: unknown encoding");
  return 1;
}

/// 1/m along the camera's axis, 0 for none: an IEEE 754 half, little-endian, with 5 bits of exponent and 10 of fraction.
float inverse_depth(const unsigned char* bytes) {
  const unsigned bits = bytes[0] | static_cast<unsigned>(bytes[1]) << 8;
  const int exponent = bits >> 10 & 31;
  const auto fraction = static_cast<float>(bits & 1023);
  require(exponent != 31 && bits <= 0x8000, "7: inverse depth is negative or not finite");  // 0x8000 is -0
  return exponent == 0 ? std::ldexp(fraction, -24) : std::ldexp(1024 + fraction, exponent - 25);
}

/// Raw frames are of one size, one after another without padding.
std::vector<Bytes> split_evenly(Bytes payload, const Frames& frames) {
  const std::uint64_t bytes = frames.encoding == "invdepth16" ? 2 : 1;
  const std::uint64_t size = frames.height * frames.width * frames.channels * bytes;  // below 2^48
  require(size * frames.count == payload.size(), "7: shape and payload do not fit");
  std::vector<Bytes> parts;
  for (std::uint64_t i = 0; i < frames.count; ++i) parts.push_back(payload.part(i * size, size));
  return parts;
}

std::vector<Bytes> split_at(Bytes payload, const std::vector<std::string_view>& offsets, std::uint64_t count) {
  require(offsets.size() == count + 1, "7: offsets are not T + 1");
  require(to_count(offsets.front()) == 0, "7: offsets do not start at 0");
  std::vector<Bytes> parts;
  std::uint64_t start = 0;
  for (std::size_t i = 1; i < offsets.size(); ++i) {
    const auto end = static_cast<std::uint64_t>(to_count(offsets[i]));
    require(end > start && end <= payload.size(), "7: offsets do not rise to the end of the payload");
    parts.push_back(payload.part(start, end - start));
    start = end;
  }
  require(start == payload.size(), "7: offsets do not rise to the end of the payload");
  return parts;
}

Frames read_frames(const Header& header, const Topic& topic, Bytes payload) {
  const auto shape = header.list("shape");
  require(shape.size() == 4, "6: shape is not [T, H, W, C]");
  std::array<std::uint64_t, 4> sizes{};
  for (std::size_t i = 0; i < 4; ++i) {
    sizes[i] = static_cast<std::uint64_t>(to_count(shape[i]));
    require(sizes[i] >= 1 && sizes[i] <= 65535, "6: shape is out of range");
  }
  Frames frames{sizes[0], sizes[1], sizes[2], sizes[3], std::string(to_string(header["encoding"])), {}};
  require(frames.channels == channels_of(frames.encoding), "7: encoding and channels do not fit");
  const bool classes = topic.kind == "cls" || topic.kind == "vis";
  require(classes == (frames.encoding == "class8"), "7: encoding and topic do not fit");
  require((topic.kind == "depth") == (frames.encoding == "invdepth16"), "7: encoding and topic do not fit");
  header.expect("layout", "THWC");
  if (topic.kind == "depth")
    require(to_string(header["dtype"]) == "f16", "7: encoding and dtype do not fit");
  else
    header.expect("dtype", "u8");
  const bool jpeg = frames.encoding == "jpeg";
  require(jpeg == header.has("offsets"), "7: offsets belong to jpeg and only there");
  frames.payloads = jpeg ? split_at(payload, header.list("offsets"), frames.count) : split_evenly(payload, frames);
  return frames;
}

std::vector<std::string> read_roles(const Header& header, std::uint64_t count) {
  std::vector<std::string> roles;
  for (const std::string_view role : header.list("frame_role")) roles.emplace_back(to_string(role));
  require(roles.size() == count, "7: frame_role and shape do not fit");
  for (const auto& role : roles) require(role == "in_transit" || role == "at_goal", "6: unknown frame_role");
  return roles;
}

View read_view(const Envelope& envelope, const Header& header, const Topic& topic) {
  View view{read_origin(envelope, header, topic), read_frames(header, topic, envelope.payload), {}, 0, 0, 0, true};
  view.roles = read_roles(header, view.frames.count);
  view.age_ms = to_number(header["age_ms"]);
  view.published_ms = to_time_ms(header["t_publish"]);
  view.valid_for_ms = static_cast<double>(to_integer(header["valid_for_ms"]));
  if (header.has("synthetic")) {
    view.synthetic = header["synthetic"] == "true";
    require(view.synthetic || header["synthetic"] == "false", "6: synthetic is neither true nor false");
  }
  require(topic.kind != "std" || header.has("scale"), "7: std without scale");
  return view;
}

double now_ms() {
  const auto now = std::chrono::system_clock::now().time_since_epoch();
  return std::chrono::duration<double, std::milli>(now).count();
}

// ---- what is remembered from message to message -------------------------------------------------------------------

/// Sequence, revision and boot_id of one topic. Answers how many messages were missed.
class Past {
 public:
  std::uint64_t admit(const Origin& origin, std::uint64_t sequence) {
    if (boot_id_ != origin.boot_id) forget(origin.boot_id);
    require(!sequence_ || sequence > *sequence_, "sequence seen before");
    const std::uint64_t skipped = sequence_ ? sequence - *sequence_ - 1 : 0;
    sequence_ = sequence;
    require(origin.view_rev >= view_rev_, "older revision of the view");
    view_rev_ = origin.view_rev;
    return skipped;
  }

 private:
  void forget(const std::string& boot_id) {
    if (!boot_id_.empty()) std::printf("restarted boot_id=%s\n", boot_id.c_str());
    boot_id_ = boot_id;
    sequence_.reset();
    view_rev_ = -kIntegerLimit;
  }

  std::string boot_id_;
  std::optional<std::uint64_t> sequence_;
  std::int64_t view_rev_ = -kIntegerLimit;
};

// ---- what is done with a view -------------------------------------------------------------------------------------

struct Options {
  std::string endpoint;
  Topic topic{"topdown", "win"};
  std::string pictures;          // folder; empty: none are written
  long limit = 0;                // views; 0: until the end of the stream
  double max_age_ms = HUGE_VAL;  // older views are dropped
  double timeout_s = 0;          // 0: wait for ever
  bool every = false;            // every message in order, instead of the newest
};

std::string mean_of(const Frames& frames) {
  if (frames.encoding == "jpeg") return "-";
  std::array<double, 3> sums{};
  const bool depth = frames.encoding == "invdepth16";
  for (const Bytes frame : frames.payloads)
    for (std::size_t i = 0; i < frame.size(); i += depth ? 2 : 1)
      sums[i % frames.channels] += depth ? inverse_depth(frame.begin() + i) : frame[i];
  std::string text;
  for (std::size_t channel = 0; channel < frames.channels; ++channel) {
    char number[32];
    const double pixels = static_cast<double>(frames.count * frames.height * frames.width);
    std::snprintf(number, sizeof number, "%s%.*f", channel == 0 ? "" : ",", depth ? 5 : 2, sums[channel] / pixels);
    text += number;
  }
  return text;
}

std::string hash_of_last(const Frames& frames) {
  if (frames.encoding == "jpeg") return "-";
  std::uint64_t hash = 0xcbf29ce484222325ULL;
  for (const unsigned char byte : frames.payloads.back()) hash = (hash ^ byte) * 0x100000001b3ULL;
  char text[17];
  std::snprintf(text, sizeof text, "%016" PRIx64, hash);
  return text;
}

std::string runs_of(const std::vector<std::string>& roles) {
  std::string text;
  for (std::size_t start = 0, end = 0; start < roles.size(); start = end) {
    while (end < roles.size() && roles[end] == roles[start]) ++end;
    text += (text.empty() ? "" : ",") + roles[start] + "*" + std::to_string(end - start);
  }
  return text;
}

void print_view(const View& view, const Topic& topic, std::uint64_t sequence, std::uint64_t skipped, double age_ms) {
  const Frames& frames = view.frames;
  std::printf("view=%s kind=%s window=%" PRId64 " seq=%" PRIu64 " rev=%" PRId64 " skipped=%" PRIu64 " age_ms=%.1f "
              "shape=%" PRIu64 "x%" PRIu64 "x%" PRIu64 "x%" PRIu64 " encoding=%s mean=%s hash=%s roles=%s "
              "synthetic=%s\n",
              topic.view_id.c_str(), topic.kind.c_str(), view.origin.window_id, sequence, view.origin.view_rev, skipped,
              age_ms, frames.count, frames.height, frames.width, frames.channels, frames.encoding.c_str(),
              mean_of(frames).c_str(), hash_of_last(frames).c_str(), runs_of(view.roles).c_str(),
              view.synthetic ? "true" : "false");
  std::fflush(stdout);
}

struct CannotWrite : std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// Inverse depth as PFM: floats, the last row first.
void write_pfm(std::ofstream& file, const Frames& frames, Bytes frame) {
  file << "Pf\n" << frames.width << ' ' << frames.height << "\n-1.0\n";  // little-endian, as the machines this runs on
  for (std::uint64_t y = frames.height; y > 0; --y)
    for (std::uint64_t x = 0; x < frames.width; ++x) {
      const float value = inverse_depth(frame.begin() + 2 * ((y - 1) * frames.width + x));
      file.write(reinterpret_cast<const char*>(&value), sizeof value);
    }
}

/// PPM for colour, PGM for one channel, PFM for depth; JPEG stays as it came. All parts of the name have been checked.
void write_pictures(const View& view, const Options& options) {
  const Frames& frames = view.frames;
  const bool jpeg = frames.encoding == "jpeg";
  const bool depth = frames.encoding == "invdepth16";
  const char* suffix = jpeg ? "jpg" : depth ? "pfm" : frames.channels == 3 ? "ppm" : "pgm";
  for (std::size_t i = 0; i < frames.payloads.size(); ++i) {
    char name[96];
    std::snprintf(name, sizeof name, "/%s_%s_%06" PRId64 "_%02zu.%s", options.topic.view_id.c_str(),
                  options.topic.kind.c_str(), view.origin.window_id, i, suffix);
    std::ofstream file(options.pictures + name, std::ios::binary);
    if (depth) write_pfm(file, frames, frames.payloads[i]);
    else if (!jpeg) file << (frames.channels == 3 ? "P6\n" : "P5\n") << frames.width << ' ' << frames.height << "\n255\n";
    if (!depth) file.write(frames.payloads[i].text(), static_cast<std::streamsize>(frames.payloads[i].size()));
    file.close();
    if (!file) throw CannotWrite("cannot write " + options.pictures + name + ": does the folder exist, is there room?");
  }
}

enum class Heard { kView, kEnd };

/// One message from the first rule to the last. Throws Dropped for one that must not be used.
Heard take(Bytes part, const Options& options, Past& past) {
  const Envelope envelope = open_envelope(part);
  require(envelope.topic == options.topic.padded(), "4: another topic");
  require(envelope.has_payload() != envelope.ends_stream(), "7: flags say neither view nor end of stream");
  const Header header(envelope.header);
  if (envelope.ends_stream()) {
    require(envelope.payload.size() == 0, "7: an end of stream with a payload");
    const Origin origin = read_origin(envelope, header, options.topic);
    std::printf("end view=%s kind=%s window=%" PRId64 "\n", options.topic.view_id.c_str(), options.topic.kind.c_str(),
                origin.window_id);
    return Heard::kEnd;
  }
  const View view = read_view(envelope, header, options.topic);
  const std::uint64_t skipped = past.admit(view.origin, envelope.sequence);
  const double since_ms = std::fmax(0.0, now_ms() - view.published_ms);  // clocks that differ make no view younger
  require(since_ms <= view.valid_for_ms, "expired: valid_for_ms is over");
  require(view.age_ms + since_ms <= options.max_age_ms, "older than --max-age-ms");
  print_view(view, options.topic, envelope.sequence, skipped, view.age_ms + since_ms);
  if (!options.pictures.empty()) write_pictures(view, options);
  return Heard::kView;
}

// ---- the socket ---------------------------------------------------------------------------------------------------

volatile std::sig_atomic_t interrupted = 0;

/// A SUB socket on one topic. Closes what it opened.
class Socket {
 public:
  explicit Socket(const Options& options) : context_(zmq_ctx_new()), socket_(zmq_socket(context_, ZMQ_SUB)) {
    const std::int64_t largest = static_cast<std::int64_t>(kPrefixSize + kMaxHeader + kMaxPayload);
    const std::string topic = options.topic.padded();
    const int newest_only = options.every ? 0 : 1;
    const int linger_ms = 0;
    const int wait_ms = 100;  // so that --timeout and Ctrl-C are noticed
    const int ipv6 = options.endpoint.find("tcp://[") == 0 ? 1 : 0;
    set(ZMQ_CONFLATE, &newest_only, sizeof newest_only);
    set(ZMQ_RCVHWM, &kQueued, sizeof kQueued);
    set(ZMQ_IPV6, &ipv6, sizeof ipv6);
    set(ZMQ_MAXMSGSIZE, &largest, sizeof largest);
    set(ZMQ_LINGER, &linger_ms, sizeof linger_ms);
    set(ZMQ_RCVTIMEO, &wait_ms, sizeof wait_ms);
    set(ZMQ_SUBSCRIBE, topic.data(), topic.size());
  }
  Socket(const Socket&) = delete;
  Socket& operator=(const Socket&) = delete;
  ~Socket() {
    zmq_close(socket_);
    zmq_ctx_term(context_);
  }

  /// After all options are set: conflation does not apply to connections made before.
  void connect(const Options& options) {
    if (zmq_connect(socket_, options.endpoint.c_str()) != 0)
      throw std::invalid_argument("cannot connect to " + options.endpoint + ": " + zmq_strerror(zmq_errno()));
  }

  /// False if nothing came for a moment.
  bool receive(zmq_msg_t* message) {
    if (zmq_msg_recv(message, socket_, 0) >= 0) return true;
    if (zmq_errno() == EAGAIN || zmq_errno() == EINTR) return false;
    throw std::runtime_error(std::string("cannot receive: ") + zmq_strerror(zmq_errno()));
  }

 private:
  void set(int option, const void* value, std::size_t size) {
    if (zmq_setsockopt(socket_, option, value, size) != 0)
      throw std::runtime_error(std::string("a socket option was refused: ") + zmq_strerror(zmq_errno()));
  }

  void* context_;
  void* socket_;
};

/// zmq_msg_t that closes itself.
struct Message {
  zmq_msg_t raw;
  Message() { zmq_msg_init(&raw); }
  Message(const Message&) = delete;
  Message& operator=(const Message&) = delete;
  ~Message() { zmq_msg_close(&raw); }
  Bytes bytes() { return {static_cast<const unsigned char*>(zmq_msg_data(&raw)), zmq_msg_size(&raw)}; }
};

int run(const Options& options) {
  Socket socket(options);
  socket.connect(options);
  Past past;
  long views = 0;
  bool continued = false;  // a message of several parts is none of this protocol, nor is its last part
  double heard_ms = now_ms();
  while (interrupted == 0) {
    Message message;
    if (!socket.receive(&message.raw)) {
      if (options.timeout_s > 0 && now_ms() - heard_ms > options.timeout_s * 1e3) {
        std::fprintf(stderr, "nothing from %s for %g s\n", options.endpoint.c_str(), options.timeout_s);
        return 69;
      }
      continue;
    }
    heard_ms = now_ms();
    const bool in_parts = continued || zmq_msg_more(&message.raw) != 0;
    continued = zmq_msg_more(&message.raw) != 0;
    try {
      require(!in_parts, "1: a message of several parts");
      if (take(message.bytes(), options, past) == Heard::kEnd) return 0;
      if (++views == options.limit) return 0;
    } catch (const Dropped& dropped) {
      std::fprintf(stderr, "dropped bytes=%zu rule=%s\n", message.bytes().size(), dropped.what());
    }
  }
  return 0;
}

// ---- options ------------------------------------------------------------------------------------------------------

constexpr char kUsage[] =
    "usage: gcd-subscriber [--endpoint ipc://... | tcp://...] [--view ID] [--kind KIND] [--every]\n"
    "                      [--limit N] [--max-age-ms MS] [--timeout S] [--ppm DIR]\n"
    "KIND is win, frm, std, cls, vis or depth.\n";

std::string runtime_folder() {
  const char* own = std::getenv("RUNTIME_DIRECTORY");
  if (own != nullptr && *own != '\0') return std::string(own).substr(0, std::string(own).find(':'));
  const char* session = std::getenv("XDG_RUNTIME_DIR");
  if (session != nullptr && *session != '\0') return std::string(session) + "/gcd";
  return "/tmp/gcd-" + std::to_string(getuid());
}

double to_positive(const std::string& name, const std::string& text) {
  char* end = nullptr;
  const double number = std::strtod(text.c_str(), &end);
  if (end == text.c_str() || *end != '\0' || !(number > 0) || number > 1e9)
    throw std::invalid_argument(name + " wants a positive number, got " + text);
  return number;
}

void check_topic(const Topic& topic) {
  const bool plain = topic.view_id.find_first_not_of("abcdefghijklmnopqrstuvwxyz0123456789_") == std::string::npos;
  if (topic.view_id.empty() || topic.view_id.size() > 16 || !plain)
    throw std::invalid_argument("--view wants 1 to 16 of a-z, 0-9, _, got " + topic.view_id);
  constexpr std::array kinds{"win", "frm", "std", "cls", "vis", "depth"};
  if (std::find(kinds.begin(), kinds.end(), topic.kind) == kinds.end())
    throw std::invalid_argument("--kind wants win, frm, std, cls, vis or depth, got " + topic.kind);
}

Options read_options(const std::vector<std::string>& words) {
  Options options;
  options.endpoint = "ipc://" + runtime_folder() + "/data";
  for (std::size_t i = 0; i < words.size(); ++i) {
    const std::string& name = words[i];
    if (name == "--every") {
      options.every = true;
      continue;
    }
    if (i + 1 == words.size()) throw std::invalid_argument("unknown option, or one without its value: " + name);
    const std::string& value = words[++i];
    if (name == "--endpoint") options.endpoint = value;
    else if (name == "--view") options.topic.view_id = value;
    else if (name == "--kind") options.topic.kind = value;
    else if (name == "--ppm") options.pictures = value;
    else if (name == "--limit") options.limit = static_cast<long>(to_positive(name, value));
    else if (name == "--max-age-ms") options.max_age_ms = to_positive(name, value);
    else if (name == "--timeout") options.timeout_s = to_positive(name, value);
    else throw std::invalid_argument("unknown option: " + name);
  }
  check_topic(options.topic);
  return options;
}

}  // namespace

int main(int argc, char** argv) {
  std::signal(SIGINT, [](int) { interrupted = 1; });
  std::signal(SIGTERM, [](int) { interrupted = 1; });
  try {
    return run(read_options({argv + 1, argv + argc}));
  } catch (const CannotWrite& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 73;
  } catch (const std::invalid_argument& error) {
    std::fprintf(stderr, "error: %s\n%s", error.what(), kUsage);
    return 64;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 70;
  }
}
