// Encodes messages of ROS 2 by eProsima Fast CDR, the library of rmw_fastrtps.
//
//     g++ -std=c++17 fast_cdr.cpp -lfastcdr -o fast_cdr && ./fast_cdr MESSAGES.txt
//
// prints the version, then each message four times, as lines of hexadecimal digits: in both byte
// orders, each in a buffer of zeros and in a buffer of ones, because Fast CDR does not write the
// bytes between fields. A line of the file is a type, seconds, nanoseconds, the frame in quotes,
// integers and numbers.

#include <array>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastcdr/config.h>

using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;

struct Message
{
    std::string type;
    int32_t seconds = 0;
    uint32_t nanoseconds = 0;
    std::string frame;
    std::array<int, 3> integers{};
    std::vector<double> numbers;
};

Message read(const std::string& line)
{
    Message one;
    std::istringstream words(line);
    words >> one.type >> one.seconds >> one.nanoseconds >> std::quoted(one.frame);
    for (int& integer : one.integers) words >> integer;
    for (std::string word; words >> word;) one.numbers.push_back(std::strtod(word.c_str(), nullptr));
    return one;
}

// Fields stand in the order of the .msg files: arrays of a fixed length have no length before them.
void serialize(Cdr& cdr, const Message& one)
{
    cdr << one.seconds << one.nanoseconds << one.frame;
    if (one.type == "Imu")
    {
        cdr.serializeArray(one.numbers.data(), 37);
        return;
    }
    cdr << static_cast<int8_t>(one.integers[0]) << static_cast<uint16_t>(one.integers[1]);
    cdr.serializeArray(one.numbers.data(), 12);
    cdr << static_cast<uint8_t>(one.integers[2]);
}

void print(const Message& one, Cdr::Endianness order, char fill)
{
    std::vector<char> bytes(1024, fill);
    FastBuffer buffer(bytes.data(), bytes.size());
#if FASTCDR_VERSION_MAJOR == 1
    Cdr cdr(buffer, order, Cdr::DDS_CDR);
    cdr.serialize_encapsulation();
    serialize(cdr, one);
    const size_t length = cdr.getSerializedDataLength();
#else
#error "Fast CDR 1 is expected"
#endif
    for (size_t place = 0; place < length; ++place)
        std::printf("%02x", static_cast<unsigned char>(bytes[place]));
    std::printf("\n");
}

int main(int, char** words)
{
    std::printf("%s\n", FASTCDR_VERSION_STR);
    std::ifstream file(words[1]);
    for (std::string line; std::getline(file, line);)
        for (const auto order : {Cdr::LITTLE_ENDIANNESS, Cdr::BIG_ENDIANNESS})
            for (const char fill : {'\0', '\xff'}) print(read(line), order, fill);
}
